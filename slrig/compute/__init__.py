"""Reconstruction by a pool of machines: dask.distributed for the work, an S3 store for bundles and results."""
