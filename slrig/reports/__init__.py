"""What the HTML reports have in common."""
