"""The claims of the papers, judged from records: evidence -> figures -> claims -> judges."""
