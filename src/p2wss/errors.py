"""The one exception a user sees."""


class InputError(Exception):
    """Something the user can mend: the message is one line that names the file, the building and what to do.

    The command line prints it as it is and exits with status 2.
    """
