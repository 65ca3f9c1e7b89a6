"""Skills as data: what they are, the words that ask for them, and the policy that goes from any one to any other."""
