"""Models and how they are fitted: networks, training loop, quantisation, selection. The only folder that imports torch."""
