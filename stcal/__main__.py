"""Entry point of ``python -m stcal``, the command ``stcal``."""

from stcal.cli.entry import main

if __name__ == "__main__":
    main()
