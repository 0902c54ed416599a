"""What an oriented pair is worth: assessment beyond its residuals."""
