"""Reference pages written from code and records: one for each method and one for each scenario."""
