"""The steps from one shape of the catalogue to the next, oldest first."""
