"""The one exception that a user's mistake or a damaged input becomes."""


class SemiparamError(ValueError):
    """One clear sentence: what was wrong, where, and what was expected.

    The command line prints it and exits with 2; the node logs it and counts it in its diagnostics.
    """
