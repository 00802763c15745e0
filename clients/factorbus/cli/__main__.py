"""`python -m factorbus.cli`: the same as `factorbus`, for an interpreter without its scripts on the path."""

import sys

from factorbus.cli.entry import main

sys.exit(main())
