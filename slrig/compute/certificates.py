"""Certificates for a pool: an authority of its own, and what each machine shows to the others."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from slrig.bundle import write_file
from slrig.compute.security import AUTHORITY, CERTIFICATE, KEY
from slrig.config import read_private_text
from slrig.disk import storage_errors
from slrig.errors import ConfigError
from slrig.jobs.records import utc_now

AUTHORITY_KEY = "authority-key.pem"
"""Key that admits members to the pool; it stays on the machine that made it."""

AUTHORITY_DAYS, MACHINE_DAYS = 3650, 825
"""825 days is the longest that systems take a server's certificate for (CA/Browser Forum, ballot 193)."""

LONGEST_NAME = 64
"""Longest common name of a certificate: RFC 5280, ub-common-name."""

_CLOCKS = timedelta(hours=1)
"""Largest delay of a machine's clock."""


def make_certificates(folder: Path, names: Sequence[str]) -> list[Path]:
    """Make an authority in `folder`, unless it is there, and for each name a folder with what `pool_security` reads.
    Returns those that were made; one that is there stays as it is.

    Raises
    ------
    ConfigError
        A name is not valid for a folder, or the authority's files cannot be read.
    StorageError
        The disk refused.
    """
    for name in names:
        if not name.replace("-", "").replace("_", "").isalnum() or len(name) > LONGEST_NAME:
            message = (
                f"'{name}' cannot name a machine: expected letters, digits, - and _, {LONGEST_NAME} of them at "
                "most, such as rig-7."
            )
            raise ConfigError(message)
    with storage_errors(folder):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    key_path, certificate_path = folder / AUTHORITY_KEY, folder / AUTHORITY
    if not key_path.exists():
        key = ec.generate_private_key(ec.SECP256R1())
        authority = _certificate("slrig pool", key.public_key(), None, key)
        _write_key(key_path, key)
        write_file(certificate_path, authority.public_bytes(serialization.Encoding.PEM))
    key, authority = _authority(key_path, certificate_path)
    made = []
    for name in names:
        place = folder / name
        if (place / CERTIFICATE).exists():
            continue
        with storage_errors(place):
            place.mkdir(mode=0o700, exist_ok=True)
        own = ec.generate_private_key(ec.SECP256R1())
        _write_key(place / KEY, own)
        write_file(place / AUTHORITY, authority.public_bytes(serialization.Encoding.PEM))
        shown = _certificate(name, own.public_key(), authority, key)
        write_file(place / CERTIFICATE, shown.public_bytes(serialization.Encoding.PEM))
        made.append(place)
    return made


def _authority(key_path: Path, certificate_path: Path) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
    try:
        text = read_private_text(key_path, f"the authority's key {key_path}")
        key = serialization.load_pem_private_key(text.encode(), password=None)
        authority = x509.load_pem_x509_certificate(certificate_path.read_bytes())
    except (OSError, ValueError, TypeError) as cause:
        message = f"{certificate_path.parent} holds no authority that can be used. Choose a new folder."
        raise ConfigError(message) from cause
    if not isinstance(key, ec.EllipticCurvePrivateKey) or authority.public_key() != key.public_key():
        message = f"{key_path} is not the key of {certificate_path}. Choose a new folder."
        raise ConfigError(message)
    return key, authority


def _certificate(
    name: str, key: ec.EllipticCurvePublicKey, issuer: x509.Certificate | None, signer: ec.EllipticCurvePrivateKey
) -> x509.Certificate:
    """A certificate of a key; without an issuer it is an authority's own. RFC 5280."""
    now, subject = utc_now(), x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    own = issuer is None
    last: datetime = now + timedelta(days=AUTHORITY_DAYS if own else MACHINE_DAYS)
    unused = ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement", "encipher_only")
    usage = dict.fromkeys((*unused, "decipher_only"), False)
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(subject if issuer is None else issuer.subject)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCKS)
        .not_valid_after(last if issuer is None else min(last, issuer.not_valid_after_utc))
        .add_extension(x509.BasicConstraints(ca=own, path_length=0 if own else None), critical=True)
        .add_extension(
            x509.KeyUsage(digital_signature=not own, key_cert_sign=own, crl_sign=own, **usage), critical=True
        )
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), critical=False)
    )
    if not own:
        # In a pool each connects, and is connected to.
        both = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
        builder = builder.add_extension(x509.ExtendedKeyUsage(both), critical=False)
    return builder.sign(signer, hashes.SHA256())


def _write_key(path: Path, key: ec.EllipticCurvePrivateKey) -> None:
    text = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    with storage_errors(path):
        path.touch(mode=0o600)
        path.write_bytes(text)
