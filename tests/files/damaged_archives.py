"""Damages zip archives: a member of other content, headers that are not true."""

import pathlib
import zipfile


def replace_member(
    path: pathlib.Path, name: str, content: bytes, compression=zipfile.ZIP_DEFLATED
) -> None:
    with zipfile.ZipFile(path) as archive:
        members = {each: archive.read(each) for each in archive.namelist()}
    with zipfile.ZipFile(path, "w", compression) as archive:
        for each, stored in {**members, name: content}.items():
            archive.writestr(each, stored)


def set_header_byte(path: pathlib.Path, offset: int, value: int) -> None:
    """Sets a byte in all members' headers and in their entries of the directory."""
    content = bytearray(path.read_bytes())
    for signature, shift in ((b"PK\3\4", 0), (b"PK\1\2", 2)):
        place = content.find(signature)
        while place >= 0:
            content[place + offset + shift] = value
            place = content.find(signature, place + 1)
    path.write_bytes(bytes(content))
