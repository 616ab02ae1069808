"""Adam for native updates: PyTorch's formula and state, in one pass over memory that also writes what products read."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor, nn

from switchmt_snn.native.library import library
from switchmt_snn.native.network import NativeNetwork


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
        ("channels", ctypes.c_long),
        ("places", ctypes.c_long),
    )


class NativeAdam(torch.optim.Adam):
    """:class:`torch.optim.Adam` for float32 parameters on a CPU; its state is the same.

    Steps are those of ``fused=True`` to rounding. The copies of weights that a native network has are written in the
    same pass. Hooks of steps are not called.
    """

    def __init__(self, parameters: Iterable[nn.Parameter], lr: float, eps: float, network: NativeNetwork) -> None:
        super().__init__(parameters, lr=lr, eps=eps, fused=True)
        self._network = network
        (group,) = self.param_groups
        self._tensors = (_Tensor * len(group["params"]))()
        self._found: list[dict[str, Any] | None] = [None] * len(group["params"])

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on from a state of this class or of :class:`torch.optim.Adam`.

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
            ValueError: there is a closure.
        """
        if closure is not None:
            raise ValueError("a closure, expected none: gradients are computed before a step")
        (group,) = self.param_groups
        were_true, held, moved = self._network.copies_are_true(), [], []  # held: what is pointed to must live
        for index, (tensor, parameter) in enumerate(zip(self._tensors, group["params"], strict=True)):
            tensor.gradient = None
            if parameter.grad is None:
                continue
            state = self.state[parameter]
            if state is not self._found[index] or tensor.parameter != parameter.data_ptr():
                self._find(index, parameter, state)
            gradient = _laid_out_like(parameter, parameter.grad)
            tensor.gradient = gradient.data_ptr()
            held.append(gradient)
            moved.append(parameter)
        numbers = (group["lr"], *group["betas"], group["eps"])
        library().snn_adam(ctypes.addressof(self._tensors), len(self._tensors), *numbers, torch.get_num_threads())
        torch.autograd.graph.increment_version(moved)
        if were_true:
            self._network.note_true_copies()

    step.hooked = True  # type: ignore[attr-defined]  # else PyTorch wraps it, for hooks and profilers

    def _find(self, index: int, parameter: Tensor, state: dict[str, Any]) -> None:
        """Where a parameter, its state and its copy lie; they stay there until the state is another one."""
        if not state:
            state["step"] = torch.zeros(())
            state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
            state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        self._found[index], tensor = state, self._tensors[index]
        tensor.parameter, tensor.size = parameter.data_ptr(), parameter.numel()
        places = [state[name].data_ptr() for name in ("exp_avg", "exp_avg_sq", "step")]
        tensor.mean, tensor.square, tensor.step = places
        tensor.places = 1
        if (copy := self._network.copies.get(parameter)) is not None:
            tensor.copy, tensor.low = copy.data_ptr(), copy.dtype == torch.bfloat16
            if copy.stride() != parameter.stride():  # images with channels innermost
                tensor.channels, tensor.places = parameter.shape[1], parameter[0, 0].numel()


def _laid_out_like(parameter: Tensor, gradient: Tensor) -> Tensor:
    if gradient.stride() == parameter.stride():
        return gradient
    return torch.empty_like(parameter).copy_(gradient)
