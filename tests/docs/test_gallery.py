"""The gallery: every picture is there, small enough, and shown; a browser sees what is wrong with a page."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from PIL import Image

from docs.tools import browser, gallery
from switchmt_snn.errors import MissingExtraError

ROOT = Path(__file__).parents[2]


def test_every_picture_is_there_and_shown() -> None:
    shown = set(re.findall(r"\]\(pictures/(\S+)\)", (ROOT / "docs" / "gallery.md").read_text("utf-8")))
    assert shown == {path.name for path in gallery.PICTURES.iterdir()}
    assert "](docs/pictures/atari.gif)" in (ROOT / "README.md").read_text("utf-8").split("## Start")[0]


def test_pictures_are_small_and_whole() -> None:
    paths = list(gallery.PICTURES.iterdir())
    assert sum(path.stat().st_size for path in paths) < gallery.MOST_BYTES
    for path in paths:
        with Image.open(path) as picture:
            picture.load()
            assert picture.width >= 480, path
    for name in gallery.FILMS:
        assert (gallery.PICTURES / f"{name}.gif").stat().st_size < gallery.MOST_BYTES_OF_A_FILM
        with Image.open(gallery.PICTURES / f"{name}.gif") as film:
            assert getattr(film, "n_frames", 1) == gallery.FILM_FRAMES


def test_a_machine_without_a_browser_is_told_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(MissingExtraError, match=r"no browser .* apt-get install chromium"):
        browser.find_browser()
    monkeypatch.setitem(gallery.MAKERS, "films", lambda folder: pytest.fail("a film was made first"))
    with pytest.raises(SystemExit) as stop:
        gallery.main([])
    assert stop.value.code == 2
    assert capsys.readouterr().err.startswith("error: no browser")


@pytest.mark.slow
def test_a_browser_sees_what_is_wrong_with_a_page(tmp_path: Path) -> None:
    try:
        browser.find_browser()
    except MissingExtraError as error:
        pytest.skip(str(error))
    good, bad = tmp_path / "good.html", tmp_path / "bad.html"
    good.write_text("<!doctype html><html><body style='margin:0;background:#0f0'><p>well</p></body></html>")
    bad.write_text(
        "<!doctype html><html><body><p style='width:900px'>wide</p><img src='http://localhost:9/a.png'>"
        "<script>console.error('a fault')</script></body></html>"
    )
    with browser.opened() as window:
        look = window.look(bad, browser.View(400))
        assert any(one.startswith("p.") for one in look.too_wide)
        assert "a fault" in look.complaints
        assert look.requests == ("http://localhost:9/a.png",)
        assert window.look(bad, browser.View(1280)).too_wide == ()
        look = window.look(good, browser.View(400))
        assert (look.too_wide, look.complaints, look.requests) == ((), (), ())
        shot = tmp_path / "shot.png"
        shot.write_bytes(window.photograph(0, 400, 100))
        with Image.open(shot) as picture:
            assert picture.size == (400, 100)
            assert picture.convert("RGB").getpixel((399, 99)) == (0, 255, 0)
        dark = "matchMedia('(prefers-color-scheme: dark)').matches"
        assert window.evaluate(dark) is False
        window.look(good, browser.View(400, dark=True))
        assert window.evaluate(dark) is True
        assert window.print_pdf().startswith(b"%PDF")
