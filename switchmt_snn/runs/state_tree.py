"""A nested state as tensors by path and a JSON tree in which ``{"$tensor": path}`` stands for a tensor."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from switchmt_snn.errors import CheckpointError, shown

MODEL_PREFIXES = {"online": "learner/network/", "target": "learner/target/"}


def split(state: dict[str, Any], prefix: str) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor], Any]:
    """The tensors of the model (whose paths begin with ``prefix``), all others, and the tree."""
    tensors: dict[str, torch.Tensor] = {}

    def walk(value: Any, path: str) -> Any:
        if isinstance(value, torch.Tensor):
            tensors[path] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
            return {"$tensor": path}
        if isinstance(value, np.ndarray):
            tensors[path] = torch.from_numpy(np.ascontiguousarray(value).copy())
            return {"$array": path}
        if isinstance(value, dict):
            return {str(key): walk(item, f"{path}/{key}" if path else str(key)) for key, item in value.items()}
        if isinstance(value, (list, tuple)):
            return [walk(item, f"{path}/{index}") for index, item in enumerate(value)]
        return value

    tree = walk(state, "")
    model = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
    training = {k: v for k, v in tensors.items() if not k.startswith(prefix)}
    return model, training, tree


def join(tree: Any, model: dict[str, torch.Tensor], training: dict[str, torch.Tensor], prefix: str) -> Any:
    """The state that was split.

    Raises:
        CheckpointError: a tensor is missing.
    """

    def find(path: Any) -> torch.Tensor:
        source = model if isinstance(path, str) and path.startswith(prefix) else training
        if not isinstance(path, str) or (key := path.removeprefix(prefix)) not in source:
            raise CheckpointError(f"tensor {shown(path)} is missing")
        return source[key]

    def walk(value: Any) -> Any:
        if isinstance(value, dict):
            if set(value) == {"$tensor"}:
                return find(value["$tensor"])
            if set(value) == {"$array"}:
                return find(value["$array"]).numpy()
            return {key: walk(item) for key, item in value.items()}
        return [walk(item) for item in value] if isinstance(value, list) else value

    return walk(tree)
