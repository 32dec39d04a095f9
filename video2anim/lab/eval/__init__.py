"""Evaluation of scene folders against the ground truth of synthetic clips. Definitions: docs/evaluation.md.

`truth.read_truth`, `evaluate.evaluate`, `aggregate.evaluate_set`, `report.to_json`, `report.render_html`.
"""
