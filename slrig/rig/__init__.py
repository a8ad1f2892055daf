"""The rig of the service: one owner thread, a watchdog, live pictures."""
