"""The method of MT-PCR in reading order: each step as plain functions on arrays."""
