"""``python -m sbi_active`` is the command line ``sbi-active``."""

import sys

from sbi_active.cli import main

sys.exit(main())
