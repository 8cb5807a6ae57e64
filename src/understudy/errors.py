"""The exceptions that a user can meet. All but `MissingExtraError` are `ValueError`s."""

from collections.abc import Iterable


class UnderstudyError(ValueError):
    """Something that the user can mend: an argument, a file, a setting."""


class CameraError(UnderstudyError):
    """A camera model that cannot be: zero focal length, wrong number of coefficients, ..."""


class RecordingError(UnderstudyError):
    """A recording (or a file of results) that cannot be read as a whole."""


class FrameError(RecordingError):
    """One frame cannot be read; the rest of the recording can."""


class DetectorError(UnderstudyError):
    """A detector that cannot be built, or precomputed keypoints that cannot be read."""


class ModelFileError(UnderstudyError):
    """A model file that is absent and cannot be fetched, or that is not what it should be."""


class MissingExtraError(ImportError):
    """A feature needs an optional dependency that is not installed."""

    def __init__(self, feature: str, extra: str):
        super().__init__(
            f"{feature}: an optional part is not installed. Install it with: pip install 'understudy[{extra}]'"
        )


def one_of(choices: Iterable[str]) -> str:
    """Words for an error message: the valid choices, quoted."""
    return "one of " + ", ".join(repr(c) for c in choices)
