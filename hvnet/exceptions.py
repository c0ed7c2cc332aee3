"""Exceptions that a caller may want to catch."""


class InputError(ValueError):
    """A mistake in what the user gave; the message names the file, the place and the remedy."""


class Stopped(Exception):
    """A training run was stopped by a signal; what it had done is saved."""

    def __init__(self, message: str, signal: int) -> None:
        super().__init__(message)
        self.signal = signal
