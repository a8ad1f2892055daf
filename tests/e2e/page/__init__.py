"""The page in a real browser: each screen as a person walks it."""
