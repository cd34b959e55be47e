"""Forward error correction of a frame's bits with GNU Radio's FEC objects, called without its scheduler.

Decoding takes long, and GNU Radio's decoders hold Python's lock meanwhile. So there may be other decoders, see
:class:`gr_ros2.phy.kernels.codes.CompiledDecoders`.

Invariants: a code of equal name and length is the same at both ends; soft bits are log-likelihood ratios, above 0 for a
1; coded bits are interleaved over the whole frame, so that a fade affects all parts a little; a decoder always gives a
result, and only the CRC says whether the frame is right.
"""

from __future__ import annotations

import ctypes
from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import lru_cache, partial
from itertools import chain, islice
from math import gcd
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from gr_ros2.core.errors import BackendMissingError

Bits = NDArray[np.uint8]
Soft = NDArray[np.float32]
CodeName = Literal["none", "cc", "ldpc", "polar"]

Decoder = Callable[[NDArray[Any]], Bits]
"""Decodes the soft values of one block."""

_CONSTRAINT, POLYNOMIALS = 7, (0o117, 0o155)
_CC_TAIL = 2 * (_CONSTRAINT - 1)
_CC_MIDDLE, _CC_STEP = 127.5, 12.0
"""Scaling of soft bits to the bytes that the Viterbi decoder takes: a soft bit of 10 is almost certain, and close to
the end of the range."""
_LDPC = ((152, 300, "n_0300_k_0152_gap_03"), (902, 1800, "n_1800_k_0902_gap_28"))
"""GNU Radio's codes of rate one half: data bits, coded bits, file."""
LDPC_ROUNDS = 25
_LIMIT = 20.0
"""Largest magnitude of a soft bit; the LDPC decoder computes its exponential."""
_LEAST = 1e-3
_POLAR_MOST = 2048
_POLAR_RATE = 0.625
"""Above this rate a code of twice the length is used."""
_POLAR_ROOM = int(_POLAR_MOST * _POLAR_RATE)
_POLAR_DESIGN_DB = 1.0
_GOLDEN = 0.618
_NEAR = 24
"""Coded bits that may decide together in the Viterbi decoder: those of 12 data bits."""
_TRIED = 200
"""Steps of the interleaver that are tried."""


def _fec() -> Any:
    """GNU Radio's module. It is imported when a code is made, because the compiled kernels need it for no more."""
    from gnuradio import fec

    return fec


class Decoders(Protocol):
    """Decoders of the codes."""

    def convolutional(self, bits: int) -> Decoder:
        """A decoder of ``2 * bits + 12`` levels, 0..255, into ``bits`` bits."""

    def ldpc(self, path: Path, data_bits: int) -> Decoder:
        """A decoder of log-likelihood ratios into the ``data_bits`` data bits of a block.

        :param path: the matrix, in the alist format
        """

    def polar(self, size: int, frozen: list[int]) -> Decoder:
        """A decoder of ``size`` log-likelihood ratios into the bits that are not frozen.

        :param frozen: numbers of the bits that are always 0, in increasing order
        """


class GnuRadioDecoders:
    """GNU Radio's decoders. They hold Python's lock while they work."""

    def convolutional(self, bits: int) -> Decoder:
        arguments = (bits, _CONSTRAINT, 2, list(POLYNOMIALS), 0)
        return partial(_work, _fec().cc_decoder.make(*arguments, -1, _fec().CC_TERMINATED, False), size=bits)

    def ldpc(self, path: Path, data_bits: int) -> Decoder:
        return partial(_work, _ldpc_decoder(str(path)), size=data_bits)

    def polar(self, size: int, frozen: list[int]) -> Decoder:
        data_bits = size - len(frozen)
        return partial(_work, _fec().polar_decoder_sc.make(size, data_bits, frozen, [0] * len(frozen)), size=data_bits)


GNU_RADIO = GnuRadioDecoders()


class Code(ABC):
    """A code for one number of bits.

    :param bits: number of bits per frame, before coding
    """

    coded_bits: int

    def __init__(self, bits: int) -> None:
        self.bits = bits

    @abstractmethod
    def encode(self, bits: Bits) -> Bits:
        """Encode ``bits`` bits into ``coded_bits`` bits."""

    @abstractmethod
    def decode(self, soft: Soft) -> Bits:
        """Decode ``coded_bits`` soft bits into the likeliest ``bits`` bits."""


class Uncoded(Code):
    """No coding."""

    def __init__(self, bits: int) -> None:
        super().__init__(bits)
        self.coded_bits = bits

    def encode(self, bits: Bits) -> Bits:
        return bits

    def decode(self, soft: Soft) -> Bits:
        return (soft > 0).astype(np.uint8)


class Spread(Code):
    """Interleaver around another code: it moves neighbouring bits far apart.

    :param symbol_bits: bits of an OFDM symbol, or 0. Neighbouring bits are then on different carriers, too: a carrier
        that fades does so in each symbol
    :param carrier_bits: bits of one of its carriers
    """

    def __init__(self, inner: Code, symbol_bits: int = 0, carrier_bits: int = 1) -> None:
        super().__init__(inner.bits)
        self._inner = inner
        self.coded_bits = count = inner.coded_bits
        golden = int(_GOLDEN * count)
        steps = (step for step in range(golden, golden + max(_TRIED, count - golden + 1)) if gcd(step, count) == 1)
        first = next(steps)
        tried = chain([first], islice(steps, _TRIED - 1)) if symbol_bits else ()
        step = next((step for step in tried if _apart(step, count, symbol_bits, carrier_bits)), first)
        self._order = np.arange(count) * step % count

    def encode(self, bits: Bits) -> Bits:
        spread: Bits = self._inner.encode(bits)[self._order]
        return spread

    def decode(self, soft: Soft) -> Bits:
        ordered = np.empty_like(soft)
        ordered[self._order] = soft
        return self._inner.decode(ordered)


def _apart(step: int, count: int, symbol_bits: int, carrier_bits: int) -> bool:
    """Whether each of ``count`` coded bits is on another carrier than the next ``_NEAR``, with such an interleaver."""
    ahead = np.arange(1, _NEAR) * pow(step, -1, count) % count
    off = np.concatenate((ahead, count - ahead)) % symbol_bits
    return bool(np.all((carrier_bits <= off) & (off <= symbol_bits - carrier_bits)))


class Convolutional(Code):
    """Rate 1/2, constraint length 7, ended with zeros; soft decisions, Viterbi."""

    def __init__(self, bits: int, decoders: Decoders) -> None:
        super().__init__(bits)
        self.coded_bits = self.coded(bits)
        arguments = (bits, _CONSTRAINT, 2, list(POLYNOMIALS), 0)
        self._encoder = _fec().cc_encoder.make(*arguments, _fec().CC_TERMINATED, False)
        self._decode = decoders.convolutional(bits)

    @staticmethod
    def coded(bits: int) -> int:
        """Coded bits for this number of bits."""
        return 2 * bits + _CC_TAIL

    def encode(self, bits: Bits) -> Bits:
        return _work(self._encoder, bits, self.coded_bits)

    def decode(self, soft: Soft) -> Bits:
        levels = np.clip(_CC_MIDDLE + _CC_STEP * soft, 0, 255).astype(np.uint8)
        return self._decode(levels)


class Blocks(Code):
    """A block code for any number of bits: the bits are divided into as few blocks as possible, each of the same number
    of bits.

    The remaining data bits of a block are zeros that both ends know and that are not sent ("shortening").

    :param data_bits: data bits of a block
    """

    def __init__(self, bits: int, data_bits: int) -> None:
        super().__init__(bits)
        self.count, self.each = self.cut(bits, data_bits)

    @staticmethod
    def cut(bits: int, data_bits: int) -> tuple[int, int]:
        """Number of blocks, and data bits of each."""
        count = -(-bits // data_bits)
        return count, -(-bits // count)

    def blocks_of(self, bits: Bits) -> Bits:
        """The data bits of each block, one block per row, the last one filled up with zeros."""
        padded = np.zeros(self.count * self.each, np.uint8)
        padded[: self.bits] = bits
        return padded.reshape(self.count, self.each)


class Matrix:
    """One of GNU Radio's LDPC matrices. GNU Radio needs most of a second to set one up.

    :param data_bits: data bits of a block
    :param size: coded bits of a block
    :raises BackendMissingError: if GNU Radio's matrices are not installed
    """

    def __init__(self, decoders: Decoders, data_bits: int, size: int, name: str) -> None:
        from gnuradio import gr

        path = Path(gr.prefix()) / "share" / "gnuradio" / "fec" / "ldpc" / f"{name}.alist"
        if not path.is_file():
            raise BackendMissingError(f"fec 'ldpc' needs {path}, which comes with GNU Radio (apt install gnuradio)")
        self.data_bits, self.size, self.checks = data_bits, size, size - data_bits
        self.encoder = _fec().ldpc_encoder.make(str(path))
        self.decode = decoders.ldpc(path, data_bits)


class Ldpc(Blocks):
    """Rate 1/2 and below; sum-product decoder.

    :param matrix: the matrix that :meth:`shape` names
    """

    def __init__(self, bits: int, matrix: Matrix) -> None:
        super().__init__(bits, matrix.data_bits)
        self._matrix = matrix
        self.coded_bits = self.coded(bits)

    @staticmethod
    def shape(bits: int) -> tuple[int, int, str]:
        """Data bits, coded bits and name of the matrix for this number of bits."""
        return next((code for code in _LDPC if bits <= code[0]), _LDPC[-1])

    @classmethod
    def coded(cls, bits: int) -> int:
        """Coded bits for this number of bits."""
        data_bits, size, _ = cls.shape(bits)
        count, each = cls.cut(bits, data_bits)
        return count * (each + size - data_bits)

    def encode(self, bits: Bits) -> Bits:
        matrix = self._matrix
        word = np.zeros(matrix.data_bits, np.uint8)
        out = []
        for block in self.blocks_of(bits):
            word[: self.each] = block
            # The data bits follow the check bits.
            out.append(_work(matrix.encoder, word, matrix.size)[: matrix.checks + self.each])
        return np.concatenate(out)

    def decode(self, soft: Soft) -> Bits:
        matrix = self._matrix
        levels = np.full(matrix.size, -_LIMIT, np.float32)
        out = []
        # The decoder also divides by a value that is 0 for an unknown bit.
        known = np.where(np.abs(soft) < _LEAST, np.float32(_LEAST), np.clip(soft, -_LIMIT, _LIMIT))
        for block in known.reshape(self.count, -1):
            levels[: block.size] = block
            out.append(matrix.decode(levels)[: self.each])
        data: Bits = np.concatenate(out)[: self.bits]
        return data


def _ldpc_decoder(path: str) -> Any:
    """A decoder that takes log-likelihood ratios. GNU Radio's decoder does so from 3.10.8 on; earlier ones take the
    ratios for a sigma of √½."""
    try:
        return _fec().ldpc_decoder.make(path, 0.5**0.5, LDPC_ROUNDS)
    except TypeError:
        return _fec().ldpc_decoder.make(path, LDPC_ROUNDS)


class Polar(Blocks):
    """Rate 0.31 to 0.625, blocks of up to 2048 bits, frozen bits after Arikan; successive cancellation decoder."""

    def __init__(self, bits: int, decoders: Decoders) -> None:
        super().__init__(bits, _POLAR_ROOM)
        self.coded_bits = self.coded(bits)
        self._size = size = self.coded_bits // self.count
        frozen = np.sort(np.argsort(capacities(size, _POLAR_DESIGN_DB), kind="stable")[: size - self.each]).tolist()
        self._encoder = _fec().polar_encoder.make(size, self.each, frozen, [0] * len(frozen), False)
        self._decode = decoders.polar(size, frozen)

    @classmethod
    def coded(cls, bits: int) -> int:
        """Coded bits for this number of bits."""
        count, each = cls.cut(bits, _POLAR_ROOM)
        return count << int(np.ceil(np.log2(each / _POLAR_RATE)))

    def encode(self, bits: Bits) -> Bits:
        return np.concatenate([_work(self._encoder, block, self._size) for block in self.blocks_of(bits)])

    def decode(self, soft: Soft) -> Bits:
        blocks = soft.reshape(self.count, self._size)
        data: Bits = np.concatenate([self._decode(block) for block in blocks])[: self.bits]
        return data


def capacities(size: int, design_db: float) -> NDArray[np.float64]:
    """Capacities of a polar code's bit channels, for an erasure channel with the capacity of white noise at this Es/N0
    (Arikan, 2009).

    :param size: coded bits, a power of 2
    """
    capacity = np.array([1 - np.exp(-(10 ** (design_db / 10)))])
    while len(capacity) < size:
        capacity = np.stack((capacity**2, 2 * capacity - capacity**2), axis=1).reshape(-1)
    return capacity


class Codes:
    """The codes of one name, one for each number of bits. They share the parts that are expensive to make.

    One thread may encode while another decodes.

    :param decoders: what decodes
    :param carriers: bits of an OFDM symbol, and of one of its carriers; (0, 1) for other PHYs
    """

    def __init__(self, name: CodeName, decoders: Decoders = GNU_RADIO, carriers: tuple[int, int] = (0, 1)) -> None:
        self.name = name
        self._spread = partial(Spread, symbol_bits=carriers[0], carrier_bits=carriers[1])
        self._decoders = decoders
        self._matrix = lru_cache(maxsize=len(_LDPC))(partial(Matrix, decoders))

    def coded_bits(self, bits: int) -> int:
        """Coded bits for this number of bits."""
        return bits if self.name == "none" else _CODES[self.name].coded(bits)

    def of(self, bits: int) -> Code:
        """The code for frames of this number of bits.

        :raises BackendMissingError: if GNU Radio lacks a part that the code needs
        """
        if self.name == "none":
            return Uncoded(bits)
        if self.name == "ldpc":
            return self._spread(Ldpc(bits, self._matrix(*Ldpc.shape(bits))))
        return self._spread((Convolutional if self.name == "cc" else Polar)(bits, self._decoders))


_CODES: dict[str, type[Convolutional | Ldpc | Polar]] = {"cc": Convolutional, "ldpc": Ldpc, "polar": Polar}


def _work(coder: Any, given: NDArray[Any], size: int) -> Bits:
    """One call of a GNU Radio encoder or decoder: it takes the addresses of its input and of its output."""
    given = np.ascontiguousarray(given)
    out = np.empty(size, np.uint8)
    coder.generic_work(_address(given), _address(out))
    return out


def _address(array: NDArray[Any]) -> Any:
    return _new_capsule(array.ctypes.data, None, None)


_new_capsule = ctypes.pythonapi.PyCapsule_New
_new_capsule.restype = ctypes.py_object
_new_capsule.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
