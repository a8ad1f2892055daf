"""Common parts of the HTML reports."""
