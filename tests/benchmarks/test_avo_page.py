"""The page of the views benchmark counts what was measured."""

from benchmarks.avo_page import write_avo_page

MACHINE = {"cpu": "test", "cores": 2, "memory_gb": 8, "gpu": None}


def record(hidden, avo, other):
    def figures(union):
        return {
            "wall_s": 2.0, "cpu_s": 1.0, "views": 4, "first": 0.3, "mean": 0.3, "union": union, "union_filmed": 0.9,
            "union_free": union - 0.05, "free": 3, "in_wall": [],
        }  # fmt: skip

    strategies = {"avo": figures(avo)} | {
        name: figures(other) for name in ("max-visibility", "canonical", "avo-no-depth")
    }
    return {
        "capture": "a", "name": "mug", "hidden": hidden, "gradient_error": 0.01, "gradient_error_wide": 0.02,
        "seeable": 0.51, "strategies": strategies,
    }  # fmt: skip


def test_wins_ties_and_hidden_objects_are_told_apart(tmp_path):
    records = [record(0.5, 0.7, 0.5), record(0.5, 0.51, 0.5), record(0.5, 0.3, 0.5), record(0.0, 0.9, 0.1)]
    kept = [{"capture": "a", "objects": records, "prepared_s": 0.5, "machine": MACHINE, "commit": "abc"}]
    records[0]["strategies"]["canonical"]["in_wall"] = ["wall"]
    write_avo_page(kept, tmp_path / "page.md")
    page = (tmp_path / "page.md").read_text()
    hidden, every = page.split("## Hidden objects (3)")[1].split("## All objects that were measured (4)")
    assert "| `max-visibility` | four views | 33 % | 33 % | 33 % |" in hidden
    assert "| `max-visibility` | four views | 50 % | 25 % | 25 % |" in every
    assert "| `canonical` | 50.0 | 90.0 | 30.0 | 30.0 | 4.0 | 1 | 1.0 |" in hidden
    # One object is seen as far as anything in free space sees it: nothing was left to win there.
    left = "four views, of the 1 objects of which it leaves more than a tie"
    assert f"| `canonical` | {left} | 100 % | 0 % | 0 % |" in hidden
    assert "0 of 16" in page
    assert "12 of 16 stand in free space" in page
    assert "`avo` sees more of 3 of 4 objects, of 3 by more than a tie" in page
    assert "## Pictures" not in page
