"""The error that a user's data or files can cause in this package."""


class ModelError(ValueError):
    """Data, a file or a setting that the model cannot use; the message says what is wrong and what is
    needed.
    """
