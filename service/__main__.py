"""``python -m service`` is the command ``heliotwin``."""

from service.cli import main

main()
