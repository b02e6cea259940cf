"""Classes of notes by weight. They stand in place of a plain string where notes are otherwise only read as text."""


class Grave(str):
    """A note that says that the result is wrong, or answers another question."""

    __slots__ = ()


class Aside(str):
    """A note that takes nothing from the result, or whose subject the verdict judges by itself."""

    __slots__ = ()
