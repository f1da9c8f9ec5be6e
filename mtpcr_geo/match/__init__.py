"""Matchers: from two BEVs to point pairs in them."""
