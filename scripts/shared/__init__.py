"""What all scripts share: command line, rows on disk, statistics and pictures."""
