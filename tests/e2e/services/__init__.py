"""The service with the services and systems of others."""
