"""Floor 3: constraints and their rows φ, φ̇, J, γ. No solver is known here."""
