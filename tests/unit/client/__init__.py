"""The client, before a service that answers from a table."""
