"""``python -m service`` is the command ``heliotwin``."""

from service.cli.main import main

main()
