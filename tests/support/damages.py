"""Damages of a file: functions of its bytes, drawn by hypothesis."""

import contextlib

from hypothesis import strategies as st


@st.composite
def damages(draw):
    """The file is replaced, cut, grown, or has flipped bits."""
    kind = draw(st.sampled_from(["replaced", "cut", "flipped", "grown"]))
    places = draw(st.lists(st.floats(0, 1, exclude_max=True), min_size=1, max_size=4))
    bits, some = draw(st.integers(0, 7)), draw(st.binary(max_size=64))

    def damage(content):
        if kind == "replaced":
            return some
        places_in = [int(place * len(content)) for place in places]
        if kind == "cut":
            return content[: places_in[0]]
        if kind == "grown":
            return content[: places_in[0]] + some + content[places_in[0] :]
        changed = bytearray(content)
        for place in places_in:
            changed[place] ^= 1 << bits
        return bytes(changed)

    return damage


@contextlib.contextmanager
def done_to(path, damage):
    """Damage a file, and restore it on leaving."""
    content = path.read_bytes()
    path.write_bytes(damage(content))
    try:
        yield
    finally:
        path.write_bytes(content)


def attempt(refusal, function, *arguments):
    """The function's result and None, or None and the message of its refusal."""
    try:
        return function(*arguments), None
    except refusal as error:
        return None, str(error)
