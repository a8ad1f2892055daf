"""Reconstruction by a pool of machines: orders over TLS, an S3 store for bundles and results."""
