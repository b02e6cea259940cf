"""What a note weighs: one of these words in place of a plain string, wherever notes are only read as text."""


class Grave(str):
    """A note that says that the result is wrong, or answers another question."""

    __slots__ = ()


class Aside(str):
    """A note that takes nothing from the result, or whose matter the verdict judges by itself."""

    __slots__ = ()
