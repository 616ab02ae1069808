"""Adam for native updates: PyTorch's formula and state, in one pass over memory that also writes what products read."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from switchmt_snn.spiking.native_library import library
from switchmt_snn.spiking.native_network import NativeNetwork


class _Tensor(ctypes.Structure):
    _fields_ = (
        ("parameter", ctypes.c_void_p),
        ("mean", ctypes.c_void_p),
        ("square", ctypes.c_void_p),
        ("gradient", ctypes.c_void_p),
        ("step", ctypes.c_void_p),
        ("copy", ctypes.c_void_p),
        ("size", ctypes.c_long),
        ("low", ctypes.c_long),
    )


class NativeAdam(torch.optim.Adam):
    """:class:`torch.optim.Adam` for float32 parameters on a CPU; its state is the same.

    Steps are those of ``fused=True`` to rounding. The copies of weights that a native network has are written in the
    same pass.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float, eps: float, network: NativeNetwork) -> None:
        super().__init__(parameters, lr=lr, eps=eps, fused=True)
        self._network = network

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a state of this class or of :class:`torch.optim.Adam`.

        Raises:
            ValueError: its moments are not those of the parameters.
        """
        super().load_state_dict(state_dict)
        for parameter, state in self.state.items():
            for name in ("exp_avg", "exp_avg_sq"):
                seen, expected = ((x.dtype, tuple(x.shape), x.stride()) for x in (state[name], parameter))
                if seen != expected:
                    raise ValueError(f"{name} is {seen}, expected that of a parameter, {expected}")

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> None:  # type: ignore[override]
        """One step; parameters without gradient stay.

        Raises:
            ValueError: there is a closure.
        """
        if closure is not None:
            raise ValueError("a closure, expected none: gradients are computed before a step")
        (group,) = self.param_groups
        moved = [parameter for parameter in group["params"] if parameter.grad is not None]
        copies, held = self._network.copies(), []  # held: what is pointed to must live until the call
        tensors = (_Tensor * len(moved))()
        for tensor, parameter in zip(tensors, moved, strict=True):
            state, copy = self._state(parameter), copies.get(parameter)
            gradient = _laid_out_like(parameter, parameter.grad)
            held.append(gradient)
            tensor.parameter, tensor.gradient = parameter.data_ptr(), gradient.data_ptr()
            tensor.mean, tensor.square = state["exp_avg"].data_ptr(), state["exp_avg_sq"].data_ptr()
            tensor.step, tensor.size = state["step"].data_ptr(), parameter.numel()
            if copy is not None:
                tensor.copy, tensor.low = copy.data_ptr(), copy.dtype == torch.bfloat16
        numbers = (group["lr"], *group["betas"], group["eps"])
        library().snn_adam(ctypes.addressof(tensors), len(moved), *numbers, torch.get_num_threads())
        torch.autograd.graph.increment_version(moved)
        if copies:
            self._network.copies_are_true()

    def _state(self, parameter: Tensor) -> dict[str, Any]:
        state: dict[str, Any] = self.state[parameter]
        if not state:
            state["step"] = torch.zeros(())
            state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
            state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        return state


def _laid_out_like(parameter: Tensor, gradient: Tensor) -> Tensor:
    if gradient.stride() == parameter.stride():
        return gradient
    return torch.empty_like(parameter).copy_(gradient)
