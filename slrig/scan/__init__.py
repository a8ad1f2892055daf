"""One scan: plan, pipeline, runner, store."""
