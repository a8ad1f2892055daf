"""A catalogue that many rigs share: what became of their jobs, and how each of them is."""
