"""The one exception the package raises on purpose."""


class StudyError(ValueError):
    """A failure that some input is expected to cause.

    The message says what was expected, what was got and what to do. The command line prints it on one
    line and exits with code 2; anything else that escapes is a bug.
    """
