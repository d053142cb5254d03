"""PNG files written byte by byte."""

import struct
import zlib

HUGE = 20_000
"""Of a side: 400 Mpx, six times what a rig's largest camera has."""


def chunk(kind: bytes, content: bytes, length: int | None = None) -> bytes:
    """A PNG chunk, which may declare a length that is not its own."""
    declared = struct.pack(">I", len(content) if length is None else length)
    return declared + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def grey_png(width: int, height: int, pixels: bytes, *before: bytes) -> bytes:
    """A PNG file of 8-bit grey.  pixels: compressed.  before: chunks that come before them."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    parts = [chunk(b"IHDR", header), *before, chunk(b"IDAT", pixels), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
