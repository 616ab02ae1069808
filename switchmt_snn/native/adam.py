"""Adam for native updates (``csrc/adam.cpp``): PyTorch's formula and state.

One pass over memory, which also writes the copies of weights that products read.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from switchmt_snn.native.library import library
from switchmt_snn.native.network import NativeNetwork


class _Tensor(ctypes.Structure):
    """``struct Tensor`` of ``csrc/adam.cpp``."""

    _fields_ = (
        ("parameter", ctypes.c_void_p),
        ("mean", ctypes.c_void_p),
        ("square", ctypes.c_void_p),
        ("gradient", ctypes.c_void_p),
        ("step", ctypes.c_void_p),
        ("copy", ctypes.c_void_p),
        ("size", ctypes.c_long),
        ("copy_is_bf16", ctypes.c_long),
        ("channels", ctypes.c_long),
        ("positions", ctypes.c_long),
    )


class NativeAdam(torch.optim.Adam):
    """``torch.optim.Adam`` for float32 parameters on a CPU; its state is the same.

    Steps are those of ``fused=True`` to rounding. The copies of weights that a native network has are written in the
    same pass. Hooks of steps are not called.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float, eps: float, network: NativeNetwork) -> None:
        super().__init__(parameters, lr=lr, eps=eps, fused=True)
        self._network = network
        (group,) = self.param_groups
        self._tensors = (_Tensor * len(group["params"]))()
        self._bound: list[dict[str, Any] | None] = [None] * len(group["params"])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a state of this class or of ``torch.optim.Adam``.

        Raises:
            ValueError: its moments are not those of the parameters; nothing is changed.
        """
        (group,), (saved,) = self.param_groups, state_dict["param_groups"]
        for number, parameter in zip(saved["params"], group["params"], strict=True):
            state = state_dict["state"].get(number, {})
            for name in state.keys() & {"exp_avg", "exp_avg_sq"}:
                seen, expected = ((x.dtype, tuple(x.shape), x.stride()) for x in (state[name], parameter))
                if seen != expected:
                    raise ValueError(f"{name} is {seen}, expected that of a parameter, {expected}")
        super().load_state_dict(state_dict)

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """One step; parameters without gradient stay.

        Raises:
            ValueError: a closure was given.
        """
        if closure is not None:
            raise ValueError("a closure, expected none: gradients are computed before a step")
        (group,) = self.param_groups
        copies_were_current = self._network.copies_are_current()
        gradients, moved = [], []  # gradients must live until C++ returns
        for index, (tensor, parameter) in enumerate(zip(self._tensors, group["params"], strict=True)):
            tensor.gradient = None
            if parameter.grad is None:
                continue
            state = self.state[parameter]
            if state is not self._bound[index] or tensor.parameter != parameter.data_ptr():
                self._bind_pointers(index, parameter, state)
            gradient = _laid_out_like(parameter, parameter.grad)
            tensor.gradient = gradient.data_ptr()
            gradients.append(gradient)
            moved.append(parameter)
        settings = (group["lr"], *group["betas"], group["eps"])
        library().snn_adam(ctypes.addressof(self._tensors), len(self._tensors), *settings, torch.get_num_threads())
        torch.autograd.graph.increment_version(moved)
        if copies_were_current:
            self._network.mark_copies_current()

    step.hooked = True  # type: ignore[attr-defined]  # else PyTorch wraps it, for hooks and profilers

    def _bind_pointers(self, index: int, parameter: Tensor, state: dict[str, Any]) -> None:
        """Take pointers to a parameter, its state and its copy; they stay valid until the state is replaced."""
        if not state:
            state["step"] = torch.zeros(())
            state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
            state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        self._bound[index], tensor = state, self._tensors[index]
        tensor.parameter, tensor.size = parameter.data_ptr(), parameter.numel()
        moments = [state[name].data_ptr() for name in ("exp_avg", "exp_avg_sq", "step")]
        tensor.mean, tensor.square, tensor.step = moments
        tensor.positions = 1
        if (copy := self._network.copies.get(parameter)) is not None:
            tensor.copy, tensor.copy_is_bf16 = copy.data_ptr(), copy.dtype == torch.bfloat16
            if copy.stride() != parameter.stride():  # images with channels innermost
                tensor.channels, tensor.positions = parameter.shape[1], parameter[0, 0].numel()


def _laid_out_like(parameter: Tensor, gradient: Tensor) -> Tensor:
    if gradient.stride() == parameter.stride():
        return gradient
    return torch.empty_like(parameter).copy_(gradient)
