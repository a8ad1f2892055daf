"""Patterns as described data: each module holds an encoding beside its inverse."""
