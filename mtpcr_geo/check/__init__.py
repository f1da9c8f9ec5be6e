"""Checks of one or two clouds before they are registered: what they are, and what is wrong with them."""

from mtpcr_geo.check.describe import CloudFacts
from mtpcr_geo.check.findings import Finding
from mtpcr_geo.check.preflight import CheckReport, check_clouds

__all__ = ["CheckReport", "CloudFacts", "Finding", "check_clouds"]
