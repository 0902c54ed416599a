"""What an oriented pair could tell: assessment beyond its residuals."""
