"""Work for the rig at set times: recurrence, due runs, retries and notices."""
