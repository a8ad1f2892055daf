"""A catalogue that many rigs share."""
