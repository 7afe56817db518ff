"""At home in Hugin: a stand-in for enblend, and what makes Hugin call it."""
