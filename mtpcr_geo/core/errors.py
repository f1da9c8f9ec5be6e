"""Everything a user can cause, as one family of exceptions with documented exit codes.

A message says what is wrong, where, and what to do about it. The command prints it in one line and
exits with the class's code:

====  ==============================================================
code  meaning
====  ==============================================================
0     done; for ``register``: accepted
2     the command line, a pipeline or an option is wrong
3     registered, but the verdict is *doubtful*
4     the verdict is *refused*; evidence is written, no registered cloud
5     an input cannot be read or holds nothing usable
6     the coordinate reference systems do not allow it
7     an output cannot be written
8     an optional part (PDAL, a model file) is missing
9     ``verify``: the run was not reproduced, or what it came from has changed
70    a defect of the program itself (please report it)
130   interrupted
====  ==============================================================
"""

from mtpcr_geo.core.wording import visible

EXIT_DOUBTFUL = 3
EXIT_REFUSED = 4
EXIT_DIFFERENT = 9
EXIT_DEFECT = 70
EXIT_INTERRUPTED = 130


def one_line(text: str) -> str:
    """Return a message in one line, with characters that are not shown written as escapes."""
    return visible(" ".join(text.split()))


class MtpcrError(Exception):
    """Base of every error a user can cause."""

    exit_code = 1

    def __str__(self) -> str:
        return visible(super().__str__())


class OptionError(MtpcrError):
    """An option, a pipeline or the command line is wrong."""

    exit_code = 2


class InputError(MtpcrError):
    """An input file cannot be read, or holds nothing that can be used."""

    exit_code = 5


class CrsError(MtpcrError):
    """A coordinate reference system is missing, not handled, or does not match the other one."""

    exit_code = 6


class OutputError(MtpcrError):
    """An output cannot be written, or exists already."""

    exit_code = 7


class MissingPartError(MtpcrError):
    """An optional part (PDAL, a model file) is needed and not there."""

    exit_code = 8


class RegistrationError(MtpcrError):
    """The clouds were read, but a step of the method has nothing to work with.

    The run is refused: exit code 4, evidence is kept, no registered cloud is written.
    """

    exit_code = EXIT_REFUSED
