"""One file per method: each holds only what differs from plain fine-tuning."""
