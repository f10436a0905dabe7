"""The paper's experiment, tables and figures, with DeepUWB and its simulated stand-in. Only `commands` imports it."""
