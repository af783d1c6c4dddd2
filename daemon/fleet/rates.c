/* What jobs take on which host: internal.h. */
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "daemon/fleet/internal.h"

static void print_rates(const struct job_rate *rates, int count, char ret_text[LEDGER_RATES_SIZE])
{
	size_t length = 0;

	ret_text[0] = '\0';
	for (int i = 0; i < count && length + 64 < LEDGER_RATES_SIZE; i++)
		length +=
		    (size_t)snprintf(ret_text + length, LEDGER_RATES_SIZE - length, "%s:%u:%d:%.4g ",
				     stage_names[rates[i].stage], rates[i].variant, rates[i].devices, rates[i].seconds);
}

/* What another version of this program has written may have stages that this one does not know: they are left out. */
static int read_rates(const char *text, struct job_rate ret_rates[JOB_RATES])
{
	char name[24];
	int count = 0, length;

	for (; count < JOB_RATES; text += length) {
		struct job_rate *rate = &ret_rates[count];

		if (sscanf(text, "%20[a-z]:%u:%d:%lf %n", name, &rate->variant, &rate->devices, &rate->seconds,
			   &length) != 4)
			break;
		rate->stage = 0;
		while (rate->stage < STAGE_COUNT && strcmp(stage_names[rate->stage], name) != 0)
			rate->stage++;
		count += rate->stage < STAGE_COUNT && rate->seconds >= 0;
	}
	return count;
}

void fleet_tell_rates(struct fleet *fleet, char ret_text[LEDGER_RATES_SIZE])
{
	struct job_rate rates[JOB_RATES];

	print_rates(rates, jobs_rates(fleet->jobs, rates), ret_text);
}

int fleet_read_rates(struct fleet *fleet, struct error *err)
{
	struct jobs_host *hosts = calloc(JOBS_HOSTS_MOST, sizeof(*hosts));
	struct fleet_host *found = calloc(JOBS_HOSTS_MOST, sizeof(*found));
	int count = 0;

	if (hosts != NULL && found != NULL)
		count = homes_list_takers(fleet->homes, found, JOBS_HOSTS_MOST);
	for (int i = 0; i < count; i++) {
		const double link = supervise_link(fleet->supervise, found[i].name);

		hosts[i] = (struct jobs_host){.devices = found[i].devices, .link = link > 0 ? link : fleet->link};
		snprintf(hosts[i].name, sizeof(hosts[i].name), "%s", found[i].name);
		memcpy(hosts[i].memory, found[i].memory, sizeof(hosts[i].memory));
		hosts[i].rates = read_rates(found[i].rates, hosts[i].rate);
	}
	if (hosts != NULL)
		jobs_set_hosts(fleet->jobs, hosts, count);
	free(found);
	free(hosts);
	return hosts == NULL || found == NULL ? error_set_errno(err, ENOMEM, "list of hosts") : 0;
}
