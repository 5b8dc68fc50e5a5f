"""Search for hyper-parameters: spaces, trials, and studies that several processes share."""
