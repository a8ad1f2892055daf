"""The HTTP edge: one router per resource, errors as problem+json."""
