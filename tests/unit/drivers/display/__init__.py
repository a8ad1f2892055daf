"""The screen driver."""
