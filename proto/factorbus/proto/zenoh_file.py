"""A Zenoh configuration file that somebody has named: whether it can be read, before Zenoh tries."""

import os
from pathlib import Path

from factorbus.proto.problems import BadConfigurationFile
from factorbus.wording.unreadable import is_device, mend_of


def check_zenoh_file(file: str | os.PathLike[str], from_environment: str = "") -> None:
    """Raises BadConfigurationFile with the reason and what to do; from_environment as there.

    A pipe is left alone: what is read of it Zenoh would not get.
    """
    name = os.fspath(file)
    if is_device(name):
        raise BadConfigurationFile(name, "it is a device; name a file", from_environment)
    try:
        if not Path(name).is_fifo():
            open(name, "rb").close()
    except OSError as error:
        raise BadConfigurationFile(name, f"{error.strerror}; {mend_of(error)}", from_environment) from None
    except ValueError as error:
        raise BadConfigurationFile(name, str(error), from_environment) from None
