# SPDX-License-Identifier: MIT
"""Certificates, and a Triton in a program of a test's own."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import trustme

from rfm.serve.installation import Installation, find_installation

PUBLIC_HOST = "127.0.0.2"  # stands for an address that others reach


@dataclass(frozen=True)
class Papers:
    """PEM files of an authority, a server and a client with its certificates, and another authority."""

    ca: Path
    certificate: Path
    key: Path
    client_certificate: Path
    client_key: Path
    other_ca: Path

    @classmethod
    def issue(cls, folder: Path) -> Papers:
        papers = cls(*(folder / f"{name}.pem" for name in cls.__dataclass_fields__))
        authority = trustme.CA()
        authority.cert_pem.write_to_path(papers.ca)
        trustme.CA().cert_pem.write_to_path(papers.other_ca)
        for identities, certificate, key in (
            (("127.0.0.1", PUBLIC_HOST), papers.certificate, papers.key),
            (("client",), papers.client_certificate, papers.client_key),
        ):
            issued = authority.issue_cert(*identities)
            issued.private_key_pem.write_to_path(key)
            certificate.write_bytes(b"".join(part.bytes() for part in issued.cert_chain_pems))
        return papers

    @property
    def client(self) -> dict[str, Path]:
        """Client options with all files."""
        return {"ca_file": self.ca, "client_certificate": self.client_certificate, "client_key": self.client_key}


def other_program(folder: Path, *options: str) -> Installation:
    """The wheel's Triton with more options, where nothing shows that it is the wheel's."""
    wheel, program = find_installation(), folder / "tritonserver"
    words = " ".join([*wheel.lay_out_backends(folder / "backends"), *options])
    program.write_text(f'#!/bin/sh\nexec {wheel.executable} {words} "$@"\n')
    program.chmod(0o755)
    return Installation(program, wheel.environment)
