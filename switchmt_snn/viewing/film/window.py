"""A film in a window, at its own speed, while it is made."""

from __future__ import annotations

import importlib.util
import os
import sys

from PIL import Image

from switchmt_snn.errors import ConfigError, MissingExtraError
from switchmt_snn.viewing.film.sinks import StopFilm

SCREENS = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER")
"""Variables of which one is set where Linux has a screen."""
INSTEAD = "leave --live out, and the film goes to a file (--out)"


def require_screen() -> None:
    """Refuse a window where there is none to be had, before anything is played.

    Raises:
        MissingExtraError: pygame is not installed.
        ConfigError: no screen.
    """
    if importlib.util.find_spec("pygame") is None:
        raise MissingExtraError(
            f"--live needs pygame, which is not installed; run: pip install 'switchmt-snn[video]', or {INSTEAD}"
        )
    if sys.platform.startswith("linux") and not any(os.environ.get(name) for name in SCREENS):
        raise ConfigError(f"--live found no screen ({' and '.join(SCREENS[:2])} are not set), expected one; {INSTEAD}")


class Window:
    """A window that shows frames; closing it, Q or Escape ends the film."""

    def __init__(self, size: tuple[int, int], fps: float) -> None:
        """Open it.

        Raises:
            ConfigError: the system gives no window.
        """
        require_screen()
        os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
        import pygame

        self._pygame, self._size, self._fps = pygame, size, fps
        try:
            pygame.display.init()
            self._surface = pygame.display.set_mode(size)
        except pygame.error as error:
            raise ConfigError(f"--live cannot open a window ({error}), expected a screen; {INSTEAD}") from error
        pygame.display.set_caption("switchmt-snn play")
        self._clock = pygame.time.Clock()

    def add(self, image: Image.Image) -> None:
        """Show a frame, and wait until it is time for the next.

        Raises:
            StopFilm: the window was closed.
        """
        pygame = self._pygame
        self._surface.blit(pygame.image.frombytes(image.tobytes(), self._size, "RGB"), (0, 0))
        pygame.display.flip()
        for event in pygame.event.get():
            pressed = event.key if event.type == pygame.KEYDOWN else None
            if event.type == pygame.QUIT or pressed in (pygame.K_q, pygame.K_ESCAPE):
                raise StopFilm
        self._clock.tick(self._fps)

    def close(self) -> None:
        """Close it."""
        self._pygame.display.quit()

    def discard(self) -> None:
        """Close it."""
        self.close()
