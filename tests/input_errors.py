"""Input that cannot be used, as every test wants it refused."""

from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from modeler.types import InputError


@contextmanager
def refused(*words: str) -> Iterator[None]:
    """See to it that input is refused in one line, which has these words in it."""
    with pytest.raises(InputError) as caught:
        yield
    message = str(caught.value)
    assert [text for text in words if text not in message] == []
    assert "\n" not in message
