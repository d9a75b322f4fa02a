"""The tidy Fetch world: what a task does not need lies in a corner of the table."""
