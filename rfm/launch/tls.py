# SPDX-License-Identifier: MIT
"""TLS of Triton's gRPC port, and how ``rfm serve`` itself gets through it, whatever certificates are configured.

``rfm serve`` trusts the server's own certificate, and no authority. Where clients need a certificate it makes one for
itself, a new one at each start of Triton. Triton trusts that certificate beside the authorities of
``--grpc-client-ca``. Its key stays in this process.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path

import grpc
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rfm.config import ServeConfig
from rfm.launch.installation import ServerStartError
from rfm_client.contract.addresses import check_authorities, check_certificate

NAME = "rfm serve"
VALID = timedelta(days=3650)
CLOCKS_DIFFER = timedelta(days=1)

_ANY_HOST = "*", "any"  # a name that a wildcard stands for


@dataclass(frozen=True)
class GrpcTls:
    """Files (PEM) that Triton serves gRPC with. client_ca: who may vouch for clients, which then need a certificate"""

    certificate: Path
    key: Path
    client_ca: Path | None = None

    @classmethod
    def of(cls, config: ServeConfig) -> GrpcTls | None:
        """The files that the configuration names; None: gRPC is served without TLS."""
        if config.grpc_certificate is None or config.grpc_key is None:
            return None
        return cls(config.grpc_certificate, config.grpc_key, config.grpc_client_ca)

    def check(self) -> None:
        """Raises ServerStartError for files that Triton could not serve with."""
        try:
            check_certificate(self.certificate, self.key, "grpc_certificate, grpc_key")
            if self.client_ca is not None:
                check_authorities(self.client_ca, "grpc_client_ca")
        except ValueError as error:
            raise ServerStartError(str(error)) from None

    def arguments(self) -> list[str]:
        """Arguments of tritonserver that encrypt its gRPC port."""
        files = [f"--grpc-server-cert={self.certificate}", f"--grpc-server-key={self.key}"]
        if self.client_ca is None:
            return ["--grpc-use-ssl=true", *files]
        return ["--grpc-use-ssl-mutual=true", *files, f"--grpc-root-cert={self.client_ca}"]


class OwnTls:
    """A key and a certificate, valid from now on, for a Triton that is served with ``tls``.

    Raises ServerStartError for a certificate of the server that names no host.
    """

    def __init__(self, tls: GrpcTls) -> None:
        self._tls = tls
        server = _read(tls.certificate)
        key = ec.generate_private_key(ec.SECP256R1())
        self._certificate = _self_signed(key)
        credentials = grpc.ssl_channel_credentials(
            server.public_bytes(Encoding.PEM),
            key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()),
            self._certificate,
        )
        name = _name_of(server, tls.certificate)
        self.options = {"creds": credentials, "channel_args": [("grpc.ssl_target_name_override", name)]}

    def arguments(self, folder: Path) -> list[str]:
        """Arguments of tritonserver. A file of certificates that it is to read is written into ``folder``."""
        if self._tls.client_ca is None:
            return self._tls.arguments()
        clients = folder / "clients.pem"
        clients.write_bytes(self._tls.client_ca.read_bytes() + b"\n" + self._certificate)
        return GrpcTls(self._tls.certificate, self._tls.key, clients).arguments()


def _self_signed(key: ec.EllipticCurvePrivateKey) -> bytes:
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, NAME)])
    now = datetime.now(timezone.utc)
    certificate = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - CLOCKS_DIFFER)
        .not_valid_after(now + VALID)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.CLIENT_AUTH]), critical=False)
        .sign(key, SHA256())
    )
    return certificate.public_bytes(Encoding.PEM)


def _read(file: Path) -> x509.Certificate:
    """The certificates of the file: the first is the server's own, those that vouch for it follow."""
    try:
        return x509.load_pem_x509_certificate(file.read_bytes())
    except (OSError, ValueError) as error:
        raise ServerStartError(f"grpc_certificate: expected a certificate (PEM) at {file}, got: {error}") from None


def _name_of(certificate: x509.Certificate, file: Path) -> str:
    """A host that the certificate names. gRPC compares names even where the certificate itself is trusted."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        found = [str(name.value) for name in certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)]
    else:
        found = names.get_values_for_type(x509.DNSName)
        found += map(str, names.get_values_for_type(x509.IPAddress))
    if not found:
        raise ServerStartError(f"grpc_certificate: expected a certificate that names a host, got none at {file}")
    return found[0].replace(*_ANY_HOST)
