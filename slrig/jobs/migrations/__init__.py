"""Changes of the database's tables, in order: one chain, run at every start of the service."""
