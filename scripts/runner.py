"""What studies share: their options, each stated by its default."""

import argparse


def options_of(doc: str | None, **defaults) -> argparse.Namespace:
    """Returns the options of the command line.

    Parameters
    ----------
    doc : the script's own text, which ``--help`` prints
    defaults : by the option's name: a number, text or path; a list for an option with several values; False for a
        switch; a type for an option without a default
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in defaults.items():
        option = f"--{name.replace('_', '-')}"
        if default is False:
            parser.add_argument(option, action="store_true")
        elif isinstance(default, list):
            parser.add_argument(option, nargs="+", type=type(default[0]), default=default)
        elif isinstance(default, type):
            parser.add_argument(option, type=default)
        else:
            parser.add_argument(option, type=type(default), default=default)
    return parser.parse_args()
