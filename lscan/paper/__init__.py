"""The paper's own experiment: its chain, printed tables, bars, figures and report."""
