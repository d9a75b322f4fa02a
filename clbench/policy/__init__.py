"""The policy: a small vision-language-action model that trains on a laptop and forgets as large ones do."""
