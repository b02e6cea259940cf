"""Remarks on a run: sentences that carry what programs decide by, so that nothing reads them but people."""

from stcal.errors import StcalError

NOT_AS_DRAWN = "not-as-drawn"
"""Faces are not where the design, or the names of groups, have them."""
GROUP_LEFT_OUT = "group-left-out"
BOARD_LEFT_OUT = "board-left-out"
"""A whole board in an image, not single dots."""
ELSEWHERE = "face-elsewhere"
"""Faces that were read in an image and left out: not where others see them."""
BEGINNINGS = {NOT_AS_DRAWN: "not as drawn: ", GROUP_LEFT_OUT: "left out whole: "}


class Note(str):
    """The sentence of a remark.

    ``code`` : kind of remark; ``place`` : name of the face or group that it is about; ``words`` and ``remedy`` : the
    sentence in two parts, what was found and what to do
    """

    code: str
    place: str
    words: str
    remedy: str

    def __new__(cls, words: str, code: str = "", place: str = "", remedy: str = "", then: str = "; ") -> "Note":
        """Returns the note; ``then`` stands between words and remedy."""
        note = super().__new__(cls, f"{BEGINNINGS.get(code, '')}{words}{then if remedy else ''}{remedy}")
        note.code, note.place, note.words, note.remedy = code, place, words, remedy
        return note

    @property
    def note(self) -> str:
        """The whole sentence."""
        return str(self)

    @classmethod
    def of_group(cls, group: str, error: StcalError) -> "Note":
        """Returns the note on a group that an error leaves out."""
        return cls(error.fault, GROUP_LEFT_OUT, group, error.remedy)


def lost_groups(notes) -> list[str]:
    """Returns the names of the groups that were left out, of all notes of a run."""
    return [note.place for note in notes if isinstance(note, Note) and note.code == GROUP_LEFT_OUT]
