"""Learned models of others: loading through `transformers`, HTTP services, vision-language models. All optional."""
