"""What other people write ends no line."""

from __future__ import annotations

from hugin_abflow.oneline import commented, one_line


def test_a_line_has_no_end_within() -> None:
    text = "".join(map(chr, range(0x3000))) + "\udce9"  # the last: a byte of a name that is no UTF-8
    assert len(one_line(text).splitlines()) == 1
    assert len(one_line(text)) == len(text) and one_line(text).endswith("\udce9")
    assert one_line("Küste 1.pto") == "Küste 1.pto"
    assert commented("a\ntouch b\x1b[2J") == "# a?touch b?[2J"
