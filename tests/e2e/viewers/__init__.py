"""Viewers that other people wrote, as they show a file to somebody who has set nothing."""
