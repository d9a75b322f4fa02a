"""What depends on the policy: the same methods with two kinds of policies, and the decoders of one kind."""
