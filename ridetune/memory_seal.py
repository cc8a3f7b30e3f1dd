"""How an entry is kept from being misread: by a checksum, or by a key that nobody else has.

    Checksum    plain text, for a disk that is encrypted already; damage is found
    KeySeal     AES-256-GCM under the car's key; damage and a wrong key are found

Both bind an entry to what stands beside it in the clear, and name a passenger by a digest, so that
the name itself stands inside the entry alone.
"""

import hmac
import os
from hashlib import blake2b
from typing import Protocol

KEY_BYTES = 32
_NONCE_BYTES = 12  # NIST SP 800-38D, 8.2: random, so below 2^32 entries for one key
_CHECK_BYTES = 8


class SealError(ValueError):
    """Sealed bytes that cannot be opened: damaged, moved, or sealed in another way."""


class Seal(Protocol):
    """Closes and opens the bytes of an entry."""

    name: str

    def label(self, passenger: str) -> bytes:
        """The 16 bytes that stand for a passenger in the file."""
        ...

    def close(self, text: bytes, beside: bytes) -> bytes:
        """What the file holds for `text`, bound to what stands `beside` it."""
        ...

    def open(self, sealed: bytes, beside: bytes) -> bytes:
        """The inverse of `close`; SealError where the bytes do not belong together."""
        ...


class Checksum:
    """Readable by everyone who has the file; a checksum finds damage, not forgery."""

    name = "plain"

    def label(self, passenger: str) -> bytes:
        """A digest that anyone can compute who knows the passenger's name."""
        return blake2b(passenger.encode(), digest_size=16).digest()

    def close(self, text: bytes, beside: bytes) -> bytes:
        """Checksum of both, then the text."""
        return self._check(text, beside) + text

    def open(self, sealed: bytes, beside: bytes) -> bytes:
        """The text behind its checksum."""
        check, text = sealed[:_CHECK_BYTES], sealed[_CHECK_BYTES:]
        if check != self._check(text, beside):
            raise SealError("its checksum does not fit")
        return text

    @staticmethod
    def _check(text: bytes, beside: bytes) -> bytes:
        head = len(beside).to_bytes(4, "big") + beside
        return blake2b(head + text, digest_size=_CHECK_BYTES).digest()


class KeySeal:
    """Readable with the key alone: AES-256-GCM with a fresh random nonce for each entry.

    key: 32 random bytes. ValueError for another length, or without the package `cryptography`.
    """

    name = "sealed"

    def __init__(self, key: bytes) -> None:
        if len(key) != KEY_BYTES:
            raise ValueError(
                f"the memory's key has {len(key)} bytes, it needs {KEY_BYTES}; "
                "`openssl rand -hex 32` makes one"
            )
        try:
            from cryptography.hazmat.primitives.ciphers.aead import AESGCM
        except ImportError as error:
            raise ValueError(
                "a key for the memory needs the package cryptography; "
                "run `pip install 'ridetune[secure]'`"
            ) from error
        # One key for each purpose; a label never helps against the cipher.
        self._label_key = hmac.digest(key, b"ridetune memory label", "sha256")
        self._cipher = AESGCM(hmac.digest(key, b"ridetune memory cipher", "sha256"))

    def label(self, passenger: str) -> bytes:
        """A digest that says nothing about the passenger without the key."""
        return blake2b(passenger.encode(), digest_size=16, key=self._label_key).digest()

    def close(self, text: bytes, beside: bytes) -> bytes:
        """Nonce, ciphertext and tag."""
        nonce = os.urandom(_NONCE_BYTES)
        return nonce + bytes(self._cipher.encrypt(nonce, text, beside))

    def open(self, sealed: bytes, beside: bytes) -> bytes:
        """The text, if key, bytes and what stands beside them fit together."""
        from cryptography.exceptions import InvalidTag

        try:
            return bytes(self._cipher.decrypt(sealed[:_NONCE_BYTES], sealed[_NONCE_BYTES:], beside))
        except (InvalidTag, ValueError) as error:  # ValueError: shorter than nonce and tag
            raise SealError("it does not fit the key") from error
