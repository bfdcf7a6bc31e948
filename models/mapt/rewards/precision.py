"""In which precision the products of a network are taken."""

from contextlib import AbstractContextManager, nullcontext
from typing import get_args

import torch

from mapt.rewards.errors import InvalidConfig
from mapt.rewards.train_config import Precision

# From this d on, products take so much of a training step that halving their numbers pays for the conversions.
LEAST_BFLOAT16_DIM = 128


def resolve_precision(name: str, hidden_dim: int, device: torch.device) -> torch.dtype:
    """The type in which products are taken; "auto" is bfloat16 where the machine multiplies it and d is large enough.

    Raises:
        InvalidConfig: if there is no such precision.
    """
    if name not in get_args(Precision):
        raise InvalidConfig(f"precision is {name!r}; known: {', '.join(get_args(Precision))}")
    if name == "auto":
        pays = hidden_dim >= LEAST_BFLOAT16_DIM and multiplies_bfloat16(device)
        return torch.bfloat16 if pays else torch.float32
    return torch.bfloat16 if name == "bfloat16" else torch.float32


def multiplies_bfloat16(device: torch.device) -> bool:
    """Whether the device has instructions for products of bfloat16."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and torch.ops.mkldnn._is_mkldnn_bf16_supported()


def products_in(dtype: torch.dtype, device: torch.device) -> AbstractContextManager[object]:
    """Within it, layers multiply in `dtype`; parameters, their gradients and the optimiser stay float32.

    Go through it forwards only, once a step, and leave it before the loss: the backward pass follows by itself.
    """
    if dtype == torch.float32:
        return nullcontext()
    return torch.autocast(device.type, dtype)


def small_products(device: torch.device) -> AbstractContextManager[object]:
    """Within it, products on a CPU are float32 again, whatever is around it.

    An attention over few agents or steps is thousands of tiny products; each conversion to bfloat16 costs more than
    it saves, and the backward pass of such an attention took three times as long.
    """
    return torch.autocast("cpu", enabled=False) if device.type == "cpu" else nullcontext()
