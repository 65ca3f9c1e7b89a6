"""`python -m servoid`: the `servoid` command where its script is not on the path."""

import sys

from servoid.tools.start import main

sys.exit(main())
