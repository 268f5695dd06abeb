"""What benchmark.sh asks: which runs a sweep has, and how far they have come."""
