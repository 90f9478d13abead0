"""The runtime type checker of the tests: beartype, for whatever beartype can decorate alone."""

from beartype import beartype
from beartype.roar import BeartypeDecorHintPep673Exception


def check_types(function):
    """Check a function's arguments and result at every call.

    The import hook decorates methods one by one, where `Self` has no meaning to beartype: methods
    that mention it stay unchecked.
    """
    try:
        return beartype(function)
    except BeartypeDecorHintPep673Exception:
        return function
