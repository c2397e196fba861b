"""What an auditor reads and takes away: queries, reports, bundles, replay."""
