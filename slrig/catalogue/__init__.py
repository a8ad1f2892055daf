"""A catalogue in Postgres that many rigs share: their jobs, and the state of each rig."""
