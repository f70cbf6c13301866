"""The paper's baselines (Lie-X section 5.2): regression forests, an AlexNet, and an ablation."""
