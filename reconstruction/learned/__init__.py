"""Optional third-party models: loading by `transformers`, HTTP services, vision-language models."""
