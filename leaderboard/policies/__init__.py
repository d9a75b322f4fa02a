"""What depends on the policy: the same methods with two kinds, and the decoders of one kind."""
