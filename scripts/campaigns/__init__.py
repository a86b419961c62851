"""Campaigns: configuration, runs, engines, store and picture."""
