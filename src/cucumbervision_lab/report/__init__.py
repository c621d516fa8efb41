"""Reports of benchmarks: tables and plots over readings, set out as one page."""
