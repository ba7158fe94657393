"""Learned models of a few thousand random parameters, saved as the real ones are, for tests of what loads them."""

import json
from contextlib import contextmanager
from pathlib import Path

import pytest

SIDE = 64  # px, of what they look at
WORDS = ("a", "photo", "of", "table", "chair", "cup", "lamp", "box")


@contextmanager
def one_thread():
    """Let torch compute with one thread."""
    torch = pytest.importorskip("torch")
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def random_model(kind, config, seed: int = 0):
    """Make a model with weights under which its outputs differ from pixel to pixel, unlike initial ones.

    Always the same ones: also those that keep their initial values are drawn from a generator of their own.
    """
    torch = pytest.importorskip("torch")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        model = kind(config)
    generator = torch.Generator().manual_seed(seed)
    for parameter in model.parameters():
        if parameter.dim() > 1:
            torch.nn.init.normal_(parameter, std=0.3, generator=generator)
    return model


def _save(model, folder: Path, mean: list[float], processor: str) -> str:
    from safetensors.torch import save_file

    folder.mkdir(parents=True, exist_ok=True)
    # Not save_pretrained: that of transformers 5.23 doubles a prefix of SAM 3's names, which the hub's weights do not.
    weights = {name: value.contiguous().clone() for name, value in model.state_dict().items()}
    save_file(weights, folder / "model.safetensors", metadata={"format": "pt"})
    model.config.save_pretrained(folder)
    size = {"height": SIDE, "width": SIDE}
    settings = {"image_processor_type": processor, "image_mean": mean, "image_std": [0.5] * 3, "size": size}
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    return str(folder)


def _sam2_configs() -> dict:
    backbone = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 8, "image_size": [SIDE, SIDE],
        "blocks_per_stage": [1, 1, 1, 1], "embed_dim_per_stage": [8, 16, 32, 64],
        "num_attention_heads_per_stage": [1, 1, 1, 1], "window_size_per_stage": [4, 4, 4, 4],
        "global_attention_blocks": [], "window_positional_embedding_background_size": [2, 2],
    }  # fmt: skip
    vision = {
        "model_type": "sam2_vision_model", "backbone_config": backbone, "fpn_hidden_size": 16,
        "backbone_channel_list": [64, 32, 16, 8], "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
    }  # fmt: skip
    return {
        "vision_config": vision,
        "prompt_encoder_config": {"hidden_size": 16, "image_size": SIDE, "mask_input_channels": 4},
        "mask_decoder_config": _DECODER,
    }


_DECODER = {
    "hidden_size": 16, "mlp_dim": 16, "num_hidden_layers": 1, "num_attention_heads": 2, "iou_head_hidden_dim": 16,
}  # fmt: skip


def save_sam2(folder: Path) -> str:
    """Save a SAM 2 with its video half, as it is on the hub."""
    transformers = pytest.importorskip("transformers")
    config = transformers.Sam2VideoConfig(
        **_sam2_configs(), image_size=SIDE, memory_attention_hidden_size=16, memory_attention_num_layers=1,
        memory_attention_feed_forward_hidden_size=16, memory_attention_num_attention_heads=1,
        memory_encoder_hidden_size=16, memory_encoder_output_channels=8, mask_downsampler_embed_dim=16,
        memory_fuser_embed_dim=16, memory_fuser_intermediate_dim=16,
    )  # fmt: skip
    return _save(
        random_model(transformers.Sam2VideoModel, config),
        folder,
        [0.485, 0.456, 0.406],
        "Sam2ImageProcessorFast",
    )


def save_tokenizer(folder: Path) -> None:
    """Save a CLIP tokenizer that knows a few words and all letters."""
    transformers = pytest.importorskip("transformers")
    letters = [chr(c) for c in range(ord("a"), ord("z") + 1)]
    tokens = [*letters, *(f"{c}</w>" for c in letters)]
    merges = []
    for word in WORDS:
        parts = [*word[:-1], f"{word[-1]}</w>"]
        while len(parts) > 1:
            merges.append((parts[0], parts[1]))
            parts = ["".join(parts[:2]), *parts[2:]]
            tokens.append(parts[0])
    unique = ["<|startoftext|>", "<|endoftext|>", *dict.fromkeys(tokens)]
    vocabulary = {token: number for number, token in enumerate(unique)}
    tokenizer = transformers.CLIPTokenizer(vocab=vocabulary, merges=list(dict.fromkeys(merges)))
    tokenizer.model_max_length = 32
    tokenizer.save_pretrained(folder)


_TEXT = {
    "vocab_size": 200, "hidden_size": 16, "intermediate_size": 16, "projection_dim": 16, "num_hidden_layers": 1,
    "num_attention_heads": 2, "max_position_embeddings": 32, "bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1,
}  # fmt: skip


def save_sam3(folder: Path) -> str:
    """Save a SAM 3 with its detector and its tracker, as it is on the hub, and a tokenizer."""
    transformers = pytest.importorskip("transformers")
    backbone = {
        "model_type": "sam3_vit_model", "hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 2,
        "num_attention_heads": 2, "image_size": SIDE, "patch_size": 16, "window_size": 2, "global_attn_indexes": [1],
        "pretrain_image_size": SIDE,
    }  # fmt: skip
    vision = {
        "model_type": "sam3_vision_model", "backbone_config": backbone, "fpn_hidden_size": 16,
        "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]],
    }  # fmt: skip
    half = {"hidden_size": 16, "num_attention_heads": 2}
    layers = half | {"num_layers": 1, "intermediate_size": 16}
    detector = {
        "model_type": "sam3", "vision_config": vision, "text_config": {"model_type": "clip_text_model", **_TEXT},
        "geometry_encoder_config": layers, "detr_encoder_config": layers,
        "detr_decoder_config": layers | {"num_queries": 8}, "mask_decoder_config": half,
    }  # fmt: skip
    tracker = {
        "model_type": "sam3_tracker_video", "vision_config": vision, "image_size": SIDE,
        "prompt_encoder_config": {"hidden_size": 16, "image_size": SIDE, "patch_size": 16, "mask_input_channels": 4},
        "mask_decoder_config": _DECODER, "memory_attention_hidden_size": 16, "memory_attention_num_layers": 1,
        "memory_attention_feed_forward_hidden_size": 16, "memory_attention_rope_feat_sizes": [4, 4],
        "memory_encoder_hidden_size": 16, "memory_encoder_output_channels": 8, "mask_downsampler_embed_dim": 16,
        "memory_fuser_embed_dim": 16, "memory_fuser_intermediate_dim": 16,
    }  # fmt: skip
    config = transformers.Sam3VideoConfig(detector_config=detector, tracker_config=tracker)
    save_tokenizer(folder)
    return _save(
        random_model(transformers.Sam3VideoModel, config), folder, [0.5] * 3, "Sam3ImageProcessorFast"
    )


def save_mask2former(folder: Path) -> str:
    """Save a Mask2Former with its image processor."""
    transformers = pytest.importorskip("transformers")
    backbone = {
        "model_type": "swin", "image_size": SIDE, "embed_dim": 8, "depths": [1, 1, 1, 1], "num_heads": [1, 1, 1, 1],
        "window_size": 4, "out_features": ["stage1", "stage2", "stage3", "stage4"],
    }  # fmt: skip
    config = transformers.Mask2FormerConfig(
        backbone_config=backbone, feature_size=32, mask_feature_size=32, hidden_dim=32, encoder_feedforward_dim=16,
        encoder_layers=1, decoder_layers=2, num_attention_heads=2, dim_feedforward=16, num_queries=10, num_labels=4,
    )  # fmt: skip
    random_model(transformers.Mask2FormerForUniversalSegmentation, config).save_pretrained(folder)
    size = {"shortest_edge": SIDE, "longest_edge": 2 * SIDE}
    settings = {
        "image_processor_type": "Mask2FormerImageProcessor",
        "size": size,
        "size_divisor": 32,
    }  # as on the hub
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    return str(folder)


def save_clip(folder: Path) -> str:
    """Save a CLIP with its tokenizer and image processor."""
    transformers = pytest.importorskip("transformers")
    vision = {
        "hidden_size": 16, "intermediate_size": 16, "projection_dim": 16, "num_hidden_layers": 1,
        "num_attention_heads": 2, "image_size": 32, "patch_size": 8,
    }  # fmt: skip
    config = transformers.CLIPConfig(text_config=_TEXT, vision_config=vision, projection_dim=16)
    random_model(transformers.CLIPModel, config).save_pretrained(folder)
    save_tokenizer(folder)
    size, crop = {"shortest_edge": 32}, {"height": 32, "width": 32}
    settings = {
        "feature_extractor_type": "CLIPFeatureExtractor",
        "size": size,
        "crop_size": crop,
    }  # as on the hub
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    return str(folder)


def save_qwen(folder: Path) -> str:
    """Save a Qwen2.5-VL with a tokenizer of bytes, as it is on the hub."""
    transformers = pytest.importorskip("transformers")
    from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers

    special = (
        "<|endoftext|>",
        "<|im_start|>",
        "<|im_end|>",
        "<|vision_start|>",
        "<|vision_end|>",
        "<|image_pad|>",
    )
    letters = sorted(pre_tokenizers.ByteLevel.alphabet())
    tokenizer = Tokenizer(models.BPE({letter: i for i, letter in enumerate(letters)}, []))
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.add_special_tokens([AddedToken(token, special=True) for token in special])
    ids = {token: tokenizer.token_to_id(token) for token in special}
    config = transformers.Qwen2_5_VLConfig(
        text_config={
            "vocab_size": tokenizer.get_vocab_size(), "hidden_size": 16, "intermediate_size": 16,
            "num_hidden_layers": 1, "num_attention_heads": 2, "num_key_value_heads": 1, "max_position_embeddings": 8192,
            "rope_scaling": {"type": "default", "rope_type": "default", "mrope_section": [1, 1, 2]},
            "bos_token_id": ids["<|endoftext|>"], "eos_token_id": ids["<|im_end|>"],
        },
        vision_config={
            "depth": 1, "hidden_size": 16, "intermediate_size": 16, "num_heads": 2, "out_hidden_size": 16,
            "fullatt_block_indexes": [0], "window_size": 56,
        },
        image_token_id=ids["<|image_pad|>"], vision_start_token_id=ids["<|vision_start|>"],
        vision_end_token_id=ids["<|vision_end|>"],
    )  # fmt: skip
    model = random_model(transformers.Qwen2_5_VLForConditionalGeneration, config)
    saved = _save(model, folder, [0.48, 0.46, 0.41], "Qwen2VLImageProcessor")
    settings = json.loads((folder / "preprocessor_config.json").read_text()) | {
        "patch_size": 14, "temporal_patch_size": 2, "merge_size": 2,
        "size": {"shortest_edge": 56 * 56, "longest_edge": 112 * 112},
    }  # fmt: skip
    (folder / "preprocessor_config.json").write_text(json.dumps(settings))
    transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, eos_token="<|im_end|>", pad_token="<|endoftext|>"
    ).save_pretrained(folder)
    return saved
