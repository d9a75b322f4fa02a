"""Scoring: from records to metrics, intervals and groups. It needs neither PyTorch nor a simulator."""
