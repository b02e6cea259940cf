"""The exception tree.

Every message is one line: what, where, measured, needed, what to do. The command line prints it and
exits with the class's ``exit_code`` (2: the input is at fault; 3: the computation could not deliver; 4: what it
delivered failed its checks, and that was asked for).
"""


class StcalError(Exception):
    """Base of every error that stcal raises on purpose."""

    exit_code = 3


class InputError(StcalError):
    """A file, an option or a folder cannot be used as it is."""

    exit_code = 2


class DetectionError(StcalError):
    """Circles, faces or boards are not found, or not found uniquely."""


class MappingError(StcalError):
    """No model can be made of a group, or the group is not linked to the others."""


class ScaleError(StcalError):
    """The model cannot be brought to millimetres."""


class DegenerateError(StcalError):
    """The geometry does not determine the answer."""


class ConvergenceError(StcalError):
    """An iteration did not reach its tolerance."""


class ChecksFailed(StcalError):
    """The result is there, and did not pass its own checks."""

    exit_code = 4
