#include "core/select.h"

/* Hoare's selection. */
float select_kth(float *values, int count, int k)
{
	int low = 0, high = count - 1;

	while (low < high) {
		const float pivot = values[(low + high) / 2];
		int i = low, j = high;

		while (i <= j) {
			while (values[i] < pivot)
				i++;
			while (values[j] > pivot)
				j--;
			if (i <= j) {
				const float value = values[i];

				values[i++] = values[j];
				values[j--] = value;
			}
		}
		if (k <= j)
			high = j;
		else if (k >= i)
			low = i;
		else
			break;
	}
	return values[k];
}

float select_median(float *values, int count)
{
	float lower;

	if (count == 0)
		return 0;
	lower = select_kth(values, count, (count - 1) / 2);
	return 0.5f * (lower + select_kth(values, count, count / 2));
}
