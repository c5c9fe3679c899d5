"""The embedded performer, sculpted in code: form, identities, skin, blendshapes."""
