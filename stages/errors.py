"""Faults by kind: what a retry can mend and what it cannot."""


class InputError(ValueError):
    """The input or the settings can never work: says what was wanted, what came, what to do."""


class TransientError(RuntimeError):
    """Worth another try: memory ran out, a mount vanished, a lock was held too long."""


class FullError(TransientError):
    """No space is left: worth another try once somebody has made room, and not before."""


class StageTimeoutError(RuntimeError):
    """A stage ran past the time it was given; what it has checkpointed is kept."""


class DivergenceError(RuntimeError):
    """An optimisation produced too many non-finite steps; names the terms that did."""
