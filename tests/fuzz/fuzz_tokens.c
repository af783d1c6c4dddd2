/* The file of tokens, and lines of the audit log: what is read is what would be written. */
#include <stdlib.h>
#include <string.h>

#include "proto/audit.h"
#include "proto/tokens.h"
#include "tests/fuzz/fuzz.h"

static void check_tokens(const struct tokens *tokens)
{
	for (int i = 0; i < tokens->count; i++) {
		const struct token *token = &tokens->list[i];
		struct tokens again;
		char line[TOKEN_LINE_MAX];
		struct error err;

		token_print(token, line);
		PROMISE(token_name_valid(token->name) && token->role > ROLE_ANYONE && token->role < ROLE_COUNT);
		PROMISE(tokens_parse(line, strlen(line), &again, &err) == 0 && again.count == 1);
		PROMISE(strcmp(again.list[0].name, token->name) == 0 && again.list[0].role == token->role);
		PROMISE(again.list[0].expires == token->expires && again.list[0].certificate == token->certificate);
		PROMISE(token->certificate || memcmp(again.list[0].sha256, token->sha256, sizeof(token->sha256)) == 0);
		tokens_clear(&again);
	}
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
	struct audit_mark mark, before = {.chain = AUDIT_FIRST_CHAIN};
	struct tokens tokens;
	struct error err;
	char *text = malloc(size + 1);

	if (text == NULL)
		return 0;
	memcpy(text, data, size);
	text[size] = '\0';
	if (tokens_parse(text, size, &tokens, &err) == 0) {
		check_tokens(&tokens);
		tokens_clear(&tokens);
	}
	/* No line that anybody made up fits the chain. */
	if (audit_line_mark(text, size, &mark))
		(void)audit_line_fits(text, size, &before);
	free(text);
	return 0;
}
