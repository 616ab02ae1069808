"""Spikes as bits, in the layout that ``csrc/products.cpp`` multiplies (a drawing is in ``native/README.md``).

Shapes: I images, H, W sides, C channels, O outputs.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from switchmt_snn.native.dense import out_side
from switchmt_snn.native.library import library
from switchmt_snn.native.pointers import FLOAT32, WORDS, pointer, typed_pointer

LANES = 64
"""Lanes of a panel."""


class Panels(NamedTuple):
    """A matrix of spikes ``[lanes, bits]``.

    Attributes:
        words: int32 ``[panels, words, LANES]``. Bit k of lane n is bit k % 32 of ``words[n // 64, k // 32, n % 64]``;
            bits and lanes beyond the matrix are 0.
        lanes: rows of the matrix: images, or windows of a convolution.
        bits: columns of the matrix: the inputs of a product.
    """

    words: Tensor
    lanes: int
    bits: int

    @classmethod
    def empty(cls, lanes: int, bits: int) -> Panels:
        """With memory for its words, not filled."""
        return cls(torch.empty(-(-lanes // LANES), -(-bits // 32), LANES, dtype=torch.int32), lanes, bits)

    @classmethod
    def of_windows(cls, words_IHWw: Tensor, kernel: int, stride: int) -> Panels:
        """A lane for every window of a convolution without padding.

        Its bits are the window's positions times whole words of channels.

        Raises:
            ValueError: the words are not contiguous int32.
        """
        images, height, width, words = words_IHWw.shape
        lanes = images * out_side(height, kernel, stride) * out_side(width, kernel, stride)
        panels = cls.empty(lanes, kernel * kernel * words * 32)
        sizes = (*words_IHWw.shape, kernel, stride, torch.get_num_threads())
        library().snn_panels_of_windows(pointer(words_IHWw, WORDS), panels.words.data_ptr(), *sizes)
        return panels

    @classmethod
    def of_images(cls, words_Iw: Tensor, channels: int, words: Tensor | None = None) -> Panels:
        """A lane for every image ``[I, ..., words]``; its bits are in the order ``[C, positions]``.

        Args:
            words_Iw: int32 words of channels.
            channels: C.
            words: memory to write to, such as a part of ``empty``'s; None allocates it.

        Raises:
            ValueError: words are not contiguous int32, or not as many as needed.
        """
        images, *sides, _ = words_Iw.shape
        positions = math.prod(sides)
        shape = (-(-images // LANES), -(-channels * positions // 32), LANES)
        words = torch.empty(shape, dtype=torch.int32) if words is None else words
        pointers = (pointer(words_Iw, WORDS), pointer(words, WORDS, shape))
        library().snn_panels_of_images(*pointers, images, positions, channels, torch.get_num_threads())
        return cls(words, images, channels * positions)

    def transposed(self) -> Panels:
        """``[bits, lanes]``."""
        other = Panels.empty(self.bits, self.lanes)
        sizes = (self.lanes, self.bits, torch.get_num_threads())
        library().snn_transpose_panels(self.words.data_ptr(), other.words.data_ptr(), *sizes)
        return other

    def times(self, weight_OK: Tensor, bias_O: Tensor) -> Tensor:
        """``[lanes, O]``: this matrix times weights, and a float32 bias; in the weights' dtype.

        Raises:
            ValueError: weights and bias do not fit, or are not contiguous.
        """
        outputs = weight_OK.shape[0]
        factors = (*typed_pointer(weight_OK, (outputs, self.bits)), pointer(bias_O, FLOAT32, (outputs,)))
        y = torch.empty(self.lanes, outputs, dtype=weight_OK.dtype)
        sizes = (outputs, self.bits, self.lanes, torch.get_num_threads())
        library().snn_multiply(*factors, self.words.data_ptr(), y.data_ptr(), *sizes)
        return y

    def gradients(self, grad_y: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of weights ``[O, bits]`` and bias ``[O]``, float32, from that of the products ``[lanes, O]``.

        Raises:
            ValueError: the gradient does not fit, or is not contiguous.
        """
        factor, transposed = typed_pointer(grad_y, (self.lanes, None)), self.transposed()
        outputs = grad_y.shape[1]
        grad_weight, grad_bias = torch.empty(outputs, self.bits), torch.empty(outputs)
        pointers = (transposed.words.data_ptr(), grad_weight.data_ptr(), grad_bias.data_ptr())
        sizes = (outputs, self.lanes, self.bits, torch.get_num_threads())
        library().snn_multiply_transposed(*factor, *pointers, *sizes)
        return grad_weight, grad_bias
