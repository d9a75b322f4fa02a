"""Scoring: from records to metrics, intervals and ranks. It needs neither PyTorch nor a simulator."""
