"""Evaluation of scene folders against the truth of synthetic clips. Definitions: docs/evaluation.md.

`truth.read_truth`, `evaluate.evaluate`, `aggregate.evaluate_set`, `report.to_json`, `report.render_html`.
"""
