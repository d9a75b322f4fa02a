"""Reference pages written from code and records: claims, findings, and one for each method and scenario."""
