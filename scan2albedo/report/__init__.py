"""Pictures a person can judge a result by."""
