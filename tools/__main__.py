"""`python -m tools`: the `servoid` command where its script is not on the path."""

import sys

from tools.cli import main

sys.exit(main())
