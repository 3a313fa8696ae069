# SPDX-License-Identifier: Apache-2.0
"""A JSON document element by element, in memory that does not grow with the document."""

from __future__ import annotations

import codecs
import json
from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

_CHUNK = 1 << 20  # bytes
_WHITESPACE = " \t\n\r"
_PUNCTUATION = 1 << 16  # characters: an error this far from the end is no unfinished element


class Readable(Protocol):
    """What can be read from."""

    def read(self, size: int = -1, /) -> bytes:
        """Return at most `size` bytes, b"" at the end."""


class JsonItem(NamedTuple):
    """An element of a list, or the value of a key.

    Attributes:
        key: key at the top of the document; None if the document is a list.
        value: the element of the list with that key; [] for an empty list, and whatever has the
            key if it is no list.
        is_element: `value` is an element of a list.
    """

    key: str | None
    value: Any
    is_element: bool


def json_items(file: Readable) -> Iterator[JsonItem]:
    """Yield the elements of a list, or those of each list in an object, one by one.

    The decoder is that of `json`: unlike streaming parsers it takes NaN, as Python writes it.

    Raises:
        ValueError: the document is no JSON, or ends early; what comes before is yielded.
    """
    return _Reader(file).items()


def items_of(value: Any) -> Iterator[JsonItem]:
    """Yield the same for a document that is decoded."""
    if isinstance(value, list):
        yield from (JsonItem(None, each, True) for each in value)
        if not value:
            yield JsonItem(None, [], False)
    elif isinstance(value, dict):
        for key, inner in value.items():
            if isinstance(inner, list) and inner:
                yield from (JsonItem(key, each, True) for each in inner)
            else:
                yield JsonItem(key, inner, False)
    else:
        yield JsonItem(None, value, False)


def json_documents(file: Readable) -> Iterator[Any]:
    """Yield the documents of a file in which one follows the other, as in JSON lines.

    Raises:
        ValueError: one of them is no JSON, or ends early; those before are yielded.
    """
    return _Reader(file).documents()


def holds_documents(start: bytes) -> bool:
    """Return whether a file that begins so holds several documents, one after the other."""
    try:
        text = codecs.getincrementaldecoder(_encoding(start))().decode(start).lstrip()
        _, end = json.JSONDecoder().raw_decode(text)
    except (ValueError, RecursionError):
        return False
    return text[end:].lstrip()[:1] in ("{", "[") and text[:1] in ("{", "[")


def _encoding(start: bytes) -> str:
    """Return the encoding of a document that begins so: UTF-16 is what PowerShell's `>` writes."""
    is_utf16 = start.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    return "utf-16" if is_utf16 else "utf-8-sig"


class _Reader:
    """The text of a file that is not yet decoded, and the place in it."""

    def __init__(self, file: Readable) -> None:
        self._file, self._text, self._at, self._ended = file, "", 0, False
        self._before = 0  # characters before `_text`
        self._whole = 0  # elements read
        self._bytes: codecs.IncrementalDecoder | None = None
        self._decode = json.JSONDecoder().raw_decode

    def items(self) -> Iterator[JsonItem]:
        """See `json_items`."""
        first = self._peek()
        if not first:
            raise ValueError("the file is empty")
        if first == "[":
            yield from self._elements(None)
        elif first == "{":
            self._at += 1
            while self._continues("}"):
                key = self._value()
                if not isinstance(key, str) or self._peek() != ":":
                    where = self._place(self._at)
                    raise ValueError(f"no JSON: a key and ':' are needed, not {key!r:.40}{where}")
                self._at += 1
                if self._peek() == "[":
                    yield from self._elements(key)
                else:
                    yield JsonItem(key, self._value(), False)
        else:
            yield JsonItem(None, self._value(), False)
        if self._peek():
            rest = self._text[self._at : self._at + 20]
            raise ValueError(f"no JSON: {rest!r} after its end{self._place(self._at)}")

    def documents(self) -> Iterator[Any]:
        """See `json_documents`."""
        while self._peek():
            yield self._value()
            self._whole += 1

    def _elements(self, key: str | None) -> Iterator[JsonItem]:
        """Yield the elements of the list that begins here."""
        self._at += 1
        empty = True
        while self._continues("]"):
            value = self._value()
            self._whole += 1
            yield JsonItem(key, value, True)
            empty = False
        if empty:
            yield JsonItem(key, [], False)

    def _continues(self, end: str) -> bool:
        """Step over a comma, or over the end of a list or object; return False at the end."""
        here = self._peek()
        if here == end:
            self._at += 1
            return False
        if here == ",":
            self._at += 1
        elif not here:
            raise ValueError(f"the file ends early{self._place(self._at)}")
        return True

    def _peek(self) -> str:
        """Return the next character that is no space, which remains the next; "" at the end."""
        while True:
            while self._at < len(self._text) and self._text[self._at] in _WHITESPACE:
                self._at += 1
            if self._at < len(self._text):
                return self._text[self._at]
            if not self._more():
                return ""

    def _value(self) -> Any:
        """Return the value that begins here."""
        self._peek()
        while True:
            try:
                value, end = self._decode(self._text, self._at)
            except json.JSONDecodeError as error:
                at = self._before + error.pos  # `_more` moves the text
                # Unless it is far from the end, the error may be that the value is unfinished.
                if len(self._text) - error.pos > _PUNCTUATION or not self._more():
                    if self._ended and at >= self._before + len(self._text.rstrip()):
                        place = self._place(len(self._text))
                        raise ValueError(f"the file ends early{place}") from None
                    place = self._place(at - self._before)
                    raise ValueError(f"no JSON: {error.msg}{place}") from None
                continue
            if end == len(self._text) and self._more():
                continue  # a number may go on
            self._at = end
            return value

    def _place(self, at: int) -> str:
        """Return where in the file a character of the text is, for an error text."""
        after = f", after {self._whole} whole elements" if self._whole else ""
        return f" at character {self._before + at}{after}"

    def _more(self) -> bool:
        """Read on; return False at the end of the file."""
        if self._ended:
            return False
        # The part to read grows with the value, so that a large one is not decoded too often.
        data = self._file.read(max(_CHUNK, len(self._text) - self._at))
        self._ended = not data
        if self._bytes is None:
            self._bytes = codecs.getincrementaldecoder(_encoding(data))()
        self._before += self._at
        self._text = self._text[self._at :] + self._bytes.decode(data, final=self._ended)
        self._at = 0
        return not self._ended
