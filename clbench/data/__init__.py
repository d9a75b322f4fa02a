"""Training data: expert demonstrations, questions about scenes, and the rules of access to them."""
