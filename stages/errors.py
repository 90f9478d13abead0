"""Faults by kind: what a retry can mend and what it cannot."""


class InputError(ValueError):
    """The input or the settings can never work: says what was wanted, what came, what to do."""


class TransientError(RuntimeError):
    """Worth another try: memory ran out, a mount vanished, a lock was held too long."""


class DivergenceError(RuntimeError):
    """An optimisation produced too many non-finite steps; names the terms that did."""
