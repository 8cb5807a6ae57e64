"""A pickle of arrays, read without running anything of it: numbers, text, containers and arrays of numbers only."""

from __future__ import annotations

import io
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from understudy.errors import ModelFileError


def read_pickle(path: Path) -> dict[str, np.ndarray]:
    """Arrays of a pickled dictionary, by names joined with `/`; a pair of arrays is (weights, biases).

    Nothing that the file names is called: see `_Unpickler`. Pickles of Python 2 are understood.
    """
    try:
        data = _Unpickler(io.BytesIO(path.read_bytes()), encoding="latin1").load()
    except ModelFileError as e:
        raise ModelFileError(f"{path}: {e}") from e
    except Exception as e:  # a broken pickle can raise nearly anything
        raise ModelFileError(f"{path}: not readable as a pickle of arrays: {type(e).__name__}: {e}") from e
    found: dict[str, np.ndarray] = {}
    try:
        _flatten(data, "", found)
    except ModelFileError as e:
        raise ModelFileError(f"{path}: {e}") from e
    if not found:
        raise ModelFileError(f"{path}: holds no arrays; expected a dictionary {{variable name: array}}")
    return found


def _flatten(data: object, name: str, found: dict[str, np.ndarray]) -> None:
    if len(found) > 10_000 or name.count("/") > 10:
        raise ModelFileError("holds too many or too deeply nested dictionaries for weights")
    if isinstance(data, _Array):
        found[name] = data.array()
    elif isinstance(data, dict):
        for key, value in data.items():
            key = key.decode("latin1") if isinstance(key, bytes) else key
            if not isinstance(key, str):
                raise ModelFileError(f"{name or 'the dictionary'!r}: names must be text, found {key!r}")
            _flatten(value, f"{name}/{key}" if name else key, found)
    elif isinstance(data, (list, tuple)) and name and len(data) == 2 and all(isinstance(d, _Array) for d in data):
        _flatten({"weights": data[0], "biases": data[1]}, name, found)
    elif isinstance(data, (int, float)) and name:
        found[name] = np.asarray(data)
    else:
        raise ModelFileError(f"{name or 'the top'!r}: expected a dictionary or an array, found {type(data).__name__}")


class _DType:
    """Stands for numpy.dtype while unpickling: numbers only."""

    def __init__(self, code: Any, align: Any = False, copy: Any = False):
        if not (isinstance(code, str) and re.fullmatch(r"[<>|=]?(f[248]|[iu][1248]|b1)", code)):
            raise ModelFileError(f"array of type {code!r}: only arrays of numbers are read")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: Any) -> None:
        if not (isinstance(state, tuple) and len(state) >= 2 and state[1] in ("<", ">", "|", "=")):
            raise ModelFileError("an array's type is malformed")
        self.dtype = self.dtype.newbyteorder(state[1])


class _Array:
    """Stands for numpy.ndarray while unpickling."""

    def __init__(self, shape: Any = (), dtype: Any = None, content: Any = b"", order: Any = "C"):
        self._set(shape, dtype, content, order)

    def __setstate__(self, state: Any) -> None:
        if not (isinstance(state, tuple) and len(state) == 5):
            raise ModelFileError("an array is malformed")
        _, shape, dtype, fortran, content = state
        self._set(shape, dtype, content, "F" if fortran else "C")

    def _set(self, shape: Any, dtype: Any, content: Any, order: Any) -> None:
        content = content.encode("latin1") if isinstance(content, str) else content  # of Python 2
        if not isinstance(content, (bytes, bytearray)) or order not in ("C", "F"):
            raise ModelFileError("an array is malformed, or not of numbers")
        self.shape, self.dtype, self.content, self.order = shape, dtype, content, order

    def array(self) -> np.ndarray:
        if not isinstance(self.dtype, _DType):
            raise ModelFileError("an array has no type")
        try:
            return np.frombuffer(self.content, self.dtype.dtype).reshape(self.shape, order=self.order)
        except (TypeError, ValueError) as e:
            raise ModelFileError(f"an array is malformed: {e}") from e


def _reconstruct(kind: Any, shape: Any, code: Any) -> _Array:
    """numpy's own first step: an empty array, whose state follows."""
    return _Array()


def _scalar(dtype: Any, content: Any = b"") -> _Array:
    return _Array((), dtype, content)


def _from_buffer(content: Any, dtype: Any, shape: Any, order: Any) -> _Array:
    return _Array(shape, dtype, content, order)


def _encode(text: Any, encoding: Any = "latin1") -> bytes:
    """How protocols before 3 write bytes."""
    if not isinstance(text, str) or encoding not in ("latin1", "latin-1"):
        raise ModelFileError("text in an encoding other than latin1")
    return text.encode("latin1")


class _Maker:
    """What a pickle gets for a name: it can be called, and nothing else. A pickle can set attributes of what it has
    loaded, so neither our functions nor our classes are handed out.
    """

    __slots__ = ("_make",)

    def __init__(self, make: Callable[..., Any]):
        self._make = make

    def __call__(self, *args: Any) -> Any:
        return self._make(*args)

    def __setstate__(self, state: Any) -> None:
        raise ModelFileError("refused: the pickle changes a class or function")


_ALLOWED: Final = MappingProxyType(
    {
        ("numpy", "dtype"): _DType,
        ("numpy", "ndarray"): _Array,
        ("_codecs", "encode"): _encode,
        ("collections", "OrderedDict"): dict,
        **{
            (f"numpy.{core}.{module}", name): stand_in
            for core in ("core", "_core")
            for module, name, stand_in in (
                ("multiarray", "_reconstruct", _reconstruct),
                ("multiarray", "scalar", _scalar),
                ("numeric", "_frombuffer", _from_buffer),
            )
        },
    }
)


class _Unpickler(pickle.Unpickler):
    """Builds containers, text, numbers and arrays of numbers. Every name of a pickle leads to a stand-in of this file,
    or is refused: nothing is imported, and none of numpy's constructors run on the file's word.
    """

    def find_class(self, module: str, name: str) -> _Maker:
        try:
            return _Maker(_ALLOWED[module, name])
        except KeyError:
            raise ModelFileError(
                f"refused: the pickle asks for {module}.{name}; only containers and arrays of numbers are read"
            ) from None

    def persistent_load(self, pid: Any) -> Any:
        raise ModelFileError("refused: the pickle refers to objects outside itself")
