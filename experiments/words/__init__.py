"""What `experiments.real_words` is made of: an embedder of real words, real scenes, and rules that answer from both."""
