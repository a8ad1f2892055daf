"""The driver kms."""
