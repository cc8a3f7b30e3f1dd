"""The human review of proposals: a local page, its durable log, and what the build reads of it."""
