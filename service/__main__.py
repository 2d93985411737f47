"""``python -m service`` is the command ``heliotwin``."""

from heliotwin.cli.main import main

main()
